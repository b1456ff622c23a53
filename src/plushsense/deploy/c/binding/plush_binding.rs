//! A toy in Rust, without std and heap. Compile plushsense.c, plush_model.c and plush_binding.c (in build.rs, with the crate
//! cc). `place` and `memory` are as large as sizes() says, and stay lent to the toy.
use core::ffi::{CStr, c_char};
use core::{marker::PhantomData, mem::size_of_val};

#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct Answer { pub ms: u32, pub state: u32, pub affect: u32, pub kind: u32, pub gesture: u32, pub confidence: u32, pub known: i32 }

#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct Event { pub what: u32, pub number: u32, pub affect: u32, pub gesture: u32, pub source: u32, pub since_ms: u32, pub ms: u32 }

unsafe extern "C" {
    static plush_model: u8;
    fn plush_model_bytes() -> u32;
    fn plush_memory_bytes(model: *const u8, bytes: u32) -> u32;
    fn plush_toy_bytes() -> u32;
    fn plush_bind(toy: *mut u64, toy_bytes: u32, model: *const u8, bytes: u32, memory: *mut u32, memory_bytes: u32) -> u32;
    fn plush_channels(toy: *const u64) -> u32;
    fn plush_push(toy: *mut u64, ms: u32, values: *const i32) -> u32;
    fn plush_read_answer(toy: *const u64, answer: *mut Answer);
    fn plush_read_event(toy: *mut u64, event: *mut Event) -> u32;
    fn plush_gesture_name(toy: *const u64, gesture: u8) -> *const c_char;
}

/// How many words `place` and `memory` need.
pub fn sizes() -> (usize, usize) {
    let bytes = unsafe { (plush_toy_bytes(), plush_memory_bytes(&raw const plush_model, plush_model_bytes())) };
    (bytes.0.div_ceil(8) as usize, bytes.1.div_ceil(4) as usize)
}

pub struct Toy<'a> { toy: *mut u64, lent: PhantomData<&'a mut [u64]> }

impl<'a> Toy<'a> {
    pub fn new(place: &'a mut [u64], memory: &'a mut [u32]) -> Result<Self, u32> {
        let (toy, bytes) = (place.as_mut_ptr(), (size_of_val(place) as u32, size_of_val(memory) as u32));
        match unsafe { plush_bind(toy, bytes.0, &raw const plush_model, plush_model_bytes(), memory.as_mut_ptr(), bytes.1) } {
            0 => Ok(Toy { toy, lent: PhantomData }),
            status => Err(status),
        }
    }
    pub fn push(&mut self, ms: u32, values: &[i32]) -> u32 {
        assert_eq!(values.len(), unsafe { plush_channels(self.toy) } as usize);
        unsafe { plush_push(self.toy, ms, values.as_ptr()) }
    }
    pub fn answer(&self) -> Answer {
        let mut answer = Answer::default();
        unsafe { plush_read_answer(self.toy, &mut answer) };
        answer
    }
    pub fn event(&mut self) -> Option<Event> {
        let mut event = Event::default();
        (unsafe { plush_read_event(self.toy, &mut event) } != 0).then_some(event)
    }
    pub fn gesture(&self, class: u32) -> &CStr {
        unsafe { CStr::from_ptr(plush_gesture_name(self.toy, class.min(255) as u8)) }
    }
}
