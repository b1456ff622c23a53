/* The few SSE2 intrinsics of plushsense.c as WebAssembly's own instructions, which have the same results. */
#include <wasm_simd128.h>

typedef v128_t __m128i;

#define _mm_setzero_si128() wasm_i32x4_const_splat(0)
#define _mm_loadu_si128(p) wasm_v128_load(p)
#define _mm_xor_si128 wasm_v128_xor
#define _mm_set1_epi32 wasm_i32x4_splat
#define _mm_unpacklo_epi8(a, b) wasm_i8x16_shuffle(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23)
#define _mm_unpackhi_epi8(a, b) wasm_i8x16_shuffle(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)
#define _mm_unpackhi_epi64(a, b) wasm_i64x2_shuffle(a, b, 1, 3)
#define _mm_cvtsi32_si128(v) wasm_i32x4_make(v, 0, 0, 0)
#define _mm_add_epi32 wasm_i32x4_add
#define _mm_madd_epi16 wasm_i32x4_dot_i16x8
#define _mm_shuffle_epi32(a, n) wasm_i32x4_shuffle(a, a, (n) & 3, (n) >> 2 & 3, (n) >> 4 & 3, (n) >> 6)
