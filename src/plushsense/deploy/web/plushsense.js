/**
 * PlushSense in a browser or in Node: the library of the toy as WebAssembly, with the same integers in every bit.
 *
 *     import { open } from "./plushsense.js";
 *
 *     const toy = await open(image);                  // bytes of plush_model.bin; plushsense.wasm lies beside this file
 *     for (const [ms, values] of frames) {
 *         toy.push(values, ms);                       // all channels, as whole steps, in the order of the layout
 *         for (const event of toy.events()) ...       // one for each touch: begun, at times named later, ended
 *         toy.answer();                               // what the network makes of the newest step, sure or not
 *     }
 *
 * open(model, wasm?) -> Promise<Toy>; then, of a toy:
 *
 *     push(values, ms), prime(values, ms)                      readings
 *     answer(), events(), probabilities(), counts()            what became of them
 *     onAnswer, onEvent                                        functions to be called with each, see Toy
 *     silence(), restart(), recalibrate()                      no reading came, a gap, other sensors
 *     swap(model), patch(bytes or null), sensitivity           another model, that of one person
 *     names, channels, id, title, layout, span, step, bytes    what is known of the model
 *
 * A gap in the stamps needs no call: the toy is warming again by itself (counts().restarts). All times are milliseconds
 * of the toy's own clock, which wraps after 2^32. What cannot be done throws a PlushError with one sentence.
 * plushsense.h describes everything in detail, also the meaning of each number.
 */

/**
 * @typedef {"warming"|"tracking"|"fault"} State
 * @typedef {"none"|"positive"|"neutral"|"negative"} Affect
 * @typedef {object} Answer what the network makes of one step; while not tracking only ms, sample and state mean anything
 * @property {number} ms time of the newest sample that it knows
 * @property {number} sample even samples since the start or the last restart
 * @property {State} state
 * @property {"idle"|"unknown"|"unsure"|"sure affect"|"sure gesture"} kind
 * @property {Affect} affect
 * @property {number} gesture index into names
 * @property {string} name
 * @property {number} confidence smoothed probability, 0 to 1 in steps of 1/32768
 * @property {number} known how clearly a gesture stands out, in steps of 1/256
 *
 * @typedef {object} Event the newest thing that happened to an event
 * @property {"begun"|"named"|"ended"} what
 * @property {number} number of the event, from 1
 * @property {Affect} affect
 * @property {number|null} gesture index into names; null: only the affect is sure
 * @property {string|null} name
 * @property {"network"|"gate"} source
 * @property {number} since_ms when it was first wanted; of an end, when it was first missed
 * @property {number} ms
 *
 * @typedef {object} Counts
 * @property {number} answers
 * @property {number} restarts gaps and clock resets
 * @property {number} invalid values out of their valid range
 * @property {number} faults how often the sensors could not be believed
 * @property {number} bad_stamps readings left out, or with the time of the one before
 * @property {number} interpolated samples made up for readings that did not come
 * @property {number} interval between readings, in 1/256 ms
 * @property {boolean} sparse most samples are made up
 * @property {boolean} suspect the newest frame is in doubt
 * @property {"none"|"waiting"|"fault"|"first"|"used"|"left out"} reading what became of the newest one
 */

export const STATES = ["warming", "tracking", "fault"];
export const AFFECTS = ["none", "positive", "neutral", "negative"];
export const KINDS = ["idle", "unknown", "unsure", "sure affect", "sure gesture"];
export const READINGS = ["none", "waiting", "fault", "first", "used", "left out"];
export const WHATS = ["nothing", "begun", "named", "ended"];
export const SOURCES = ["network", "gate"];
/** A value for a sensor that gave none. */
export const NO_READING = -(2 ** 31);
const NO_GESTURE = 255;
const MOST_EVENTS = 256; // that are kept until events() is called; then the oldest is dropped

const PROBLEMS = [
  "",
  "These bytes are not a model of PlushSense: give it the plush_model.bin of an export.",
  "This model is for another version of the library, or for sensors that calibrate themselves while this module is not (or the reverse): use the files of one export.",
  "This model is damaged: copy it again.",
  "There is not enough memory for this model.",
  "This model is for other channels than the one that is running: export one of the same layout.",
  "This patch belongs to another model: make it for the one that is running.",
];

/** What cannot be done, as one sentence; `status` is the plush_status, or 0. */
export class PlushError extends Error {
  /** @param {string} sentence @param {number} [status] */
  constructor(sentence, status = 0) {
    super(sentence);
    this.name = "PlushError";
    this.status = status;
  }
}

/**
 * Make a toy that runs a model.
 *
 * @param {Uint8Array|ArrayBuffer} model the bytes of plush_model.bin
 * @param {Uint8Array|ArrayBuffer|WebAssembly.Module} [wasm] plushsense.wasm; left out: the one beside this file
 * @returns {Promise<Toy>}
 */
export async function open(model, wasm) {
  let toy;
  try {
    const code = wasm instanceof WebAssembly.Module ? wasm : await WebAssembly.compile(wasm ?? (await besideThis()));
    const instance = await WebAssembly.instantiate(code, { plush: { told: (what) => toy._told(what) } });
    toy = new Toy(instance.exports);
  } catch (cause) {
    throw new PlushError(`The WebAssembly module cannot be used (${cause.message}): check plushsense.wasm, and that the browser is of 2021 or later.`);
  }
  toy._begin(model);
  return toy;
}

/** A value of any kind in a sentence. */
const spelt = (value) => typeof value + (Object(value) === value ? "" : ` “${String(value).slice(0, 40)}”`);

async function besideThis() {
  const file = new URL("plushsense.wasm", import.meta.url);
  if (file.protocol !== "file:") return (await fetch(file)).arrayBuffer();
  return (await import("node:fs/promises")).readFile(file);
}

/**
 * A stream of one toy; `open` makes it.
 *
 * onAnswer and onEvent are called while push(), prime() and others run, which they cannot call themselves; what they throw is
 * reported as uncaught when the call is over, and the toy goes on.
 */
export class Toy {
  constructor(c) {
    this._c = c;
    this._end = c.__heap_base.value;
    this._rooms = {};
    this._events = [];
    /** @type {((answer: Answer) => void)|null} */
    this.onAnswer = null;
    /** @type {((event: Event) => void)|null} */
    this.onEvent = null;
  }

  _begin(model) {
    const c = this._c;
    this._toy = this._room("toy", c.plush_toy_bytes());
    this._done(c.plush_web_bind(this._toy, ...this._image("model", model)));
    /** @type {number} values of one reading */
    this.channels = c.plush_channels(this._toy);
    this._values = this._room("values", 4 * this.channels);
    this._model();
  }

  _done(status) {
    if (status) throw new PlushError(PROBLEMS[status] ?? "", status);
  }

  /** What is known of the model that runs. */
  _model() {
    const c = this._c;
    const classes = c.plush_classes(this._toy);
    this._numbers = this._room("numbers", 4 * Math.max(11, 5 + 2 * classes));
    /** @type {string[]} of the gestures */
    this.names = Array.from({ length: classes }, (_, n) => this._text(c.plush_gesture_name(this._toy, n)));
    this.title = this._text(c.plush_model_title(this._toy));
    /** @type {number} CRC-32 of the image */
    this.id = c.plush_model_id(this._toy) >>> 0;
    const [, span, layout, step] = this._all();
    /** @type {number} samples that the network looks back */
    this.span = span;
    /** @type {number} stands for names, units, steps and order of the channels, as PLUSH_MODEL_LAYOUT */
    this.layout = layout;
    /** @type {number} samples from one answer to the next */
    this.step = step;
  }

  /** So many bytes of the module's memory, by a name; what was there is overwritten. */
  _room(name, bytes) {
    this._settled();
    const room = this._rooms[name];
    if (room && room.bytes >= bytes) return room.at;
    const at = (this._end + 15) & ~15;
    const lacking = Math.ceil((at + bytes - this._c.memory.buffer.byteLength) / 65536);
    try {
      if (lacking > 0) this._c.memory.grow(lacking);
    } catch {
      throw new PlushError(PROBLEMS[4], 4);
    }
    this._rooms[name] = { at, bytes };
    this._end = at + bytes;
    return at;
  }

  _put(name, given) {
    if (!(given instanceof Uint8Array || given instanceof ArrayBuffer))
      throw new PlushError("A model or patch is given as its bytes, a Uint8Array or an ArrayBuffer.");
    const bytes = new Uint8Array(given.slice());
    const at = this._room(name, bytes.length);
    new Uint8Array(this._c.memory.buffer).set(bytes, at);
    return [at, bytes.length];
  }

  /** A model, and the memory that it needs: where they are, and of how many bytes. */
  _image(name, model) {
    const image = this._put(name, model);
    const bytes = this._c.plush_memory_bytes(...image) >>> 0;
    return [...image, this._room("memory", bytes), bytes];
  }

  _text(at) {
    const bytes = new Uint8Array(this._c.memory.buffer, at);
    return new TextDecoder().decode(bytes.subarray(0, bytes.indexOf(0)));
  }

  _read(n, Kind = Uint32Array) {
    return Array.from(new Kind(this._c.memory.buffer, this._numbers, n));
  }

  _all() {
    this._c.plush_web_numbers(this._toy, this._numbers);
    return this._read(5 + 2 * this.names.length, Int32Array);
  }

  /** An answer (0) or a change of an event, in the midst of a step, out of which no error must lead. */
  _told(what) {
    this._telling = true;
    try {
      this._tell(what);
    } catch (cause) {
      queueMicrotask(() => { throw cause; });
    }
    this._telling = false;
  }

  _tell(what) {
    if (what === 0) return this.onAnswer?.(this.answer());
    this._c.plush_read_event(this._toy, this._numbers);
    const [kind, number, affect, index, source, since_ms, ms] = this._read(7);
    const gesture = index === NO_GESTURE ? null : index, name = gesture === null ? null : this.names[gesture];
    const event = { what: WHATS[kind], number, affect: AFFECTS[affect], gesture, name, source: SOURCES[source], since_ms, ms };
    if (this._events.push(event) > MOST_EVENTS) this._events.shift();
    this.onEvent?.(event);
  }

  _settled() {
    if (this._telling) throw new PlushError("onAnswer and onEvent cannot change the toy that calls them: do it when push() is over.");
  }

  _reading(values, ms) {
    this._settled();
    if (!Number.isFinite(ms)) throw new PlushError(`The time of a reading is a number of milliseconds by the clock of the toy, and not ${spelt(ms)}.`);
    if (values?.length !== this.channels)
      throw new PlushError(`A reading of this toy has ${this.channels} values, one for each channel, and not ${values?.length ?? 0}.`);
    const to = new Int32Array(this._c.memory.buffer, this._values, this.channels);
    for (let i = 0; i < to.length; i++) {
      const given = values[i] ?? NaN;
      if (typeof given !== "number") throw new PlushError(`A value of a reading is a number, or null for a sensor that gave none, and not ${spelt(given)}.`);
      const value = Math.round(given);
      to[i] = Number.isNaN(value) ? NO_READING : Math.min(Math.max(value, NO_READING), 2 ** 31 - 1);
    }
    return this._values;
  }

  /**
   * Take one reading in.
   *
   * @param {ArrayLike<number>} values whole steps of each channel; NaN or null for a sensor that gave none
   * @param {number} ms when it was measured, by the clock of the toy
   * @returns {number} how many answers fell due
   */
  push(values, ms) {
    return this._c.plush_push(this._toy, ms, this._reading(values, ms));
  }

  /** Begin again from a reading, without warming. @param {ArrayLike<number>} values a reading at rest @param {number} ms @returns {boolean} whether it was taken */
  prime(values, ms) {
    return this._c.plush_prime(this._toy, ms, this._reading(values, ms)) !== 0;
  }

  /** The newest answer, with the state of the toy. @returns {Answer} */
  answer() {
    const [sample] = this._all();
    this._c.plush_read_answer(this._toy, this._numbers);
    const [ms, state, affect, kind, gesture, confidence, known] = this._read(7);
    const sure = { kind: KINDS[kind], affect: AFFECTS[affect], gesture, name: this.names[gesture] };
    return { ms, sample: sample >>> 0, state: STATES[state], ...sure, confidence: confidence / 32768, known: known | 0 };
  }

  /** Changes of events since the last call, in order. @returns {Event[]} */
  events() {
    return this._events.splice(0);
  }

  /** Of each gesture, from 0 to 1 in steps of 1/255. @returns {number[]} */
  probabilities() {
    return this.names.map((_, n) => this._c.plush_probability(this._toy, n) / 255);
  }

  /** @returns {{logits: number[], smooth: number[]}} of each gesture, in steps of 1/256 and of 2^-27 */
  numbers() {
    const all = this._all().slice(5);
    return { logits: all.slice(0, this.names.length), smooth: all.slice(this.names.length) };
  }

  /** @returns {Counts} */
  counts() {
    this._c.plush_read_counts(this._toy, this._numbers);
    const [answers, restarts, invalid, faults, bad_stamps, interpolated, interval, sparse, suspect, reading] = this._read(10);
    const numbers = { answers, restarts, invalid, faults, bad_stamps, interpolated, interval };
    return { ...numbers, sparse: sparse !== 0, suspect: suspect !== 0, reading: READINGS[reading] };
  }

  /** @returns {number} bytes of the module's memory, which does not grow while a toy runs */
  get bytes() {
    return this._c.memory.buffer.byteLength;
  }

  /** No reading came for a while. */
  silence() {
    this._settled();
    this._c.plush_silence(this._toy);
  }

  /** Forget the past, as after a gap. */
  restart() {
    this._settled();
    this._c.plush_restart(this._toy);
  }

  /** Forget what sensors that calibrate themselves have found out: the next readings are of others, or the toy was off. */
  recalibrate() {
    this._c.plush_recalibrate?.(this._toy); // which only the module for such sensors has
  }

  /** A whole number from -128 to 127; 0: as trained. @type {number} */
  get sensitivity() {
    return this._all()[4];
  }

  set sensitivity(steps) {
    if (!Number.isInteger(steps)) throw new PlushError(`The sensitivity is a whole number from -128 to 127, and not ${spelt(steps)}.`);
    this._c.plush_set_sensitivity(this._toy, Math.min(Math.max(steps, -128), 127));
  }

  /** Run another model for the same channels; unless it can, the old one goes on. @param {Uint8Array|ArrayBuffer} model */
  swap(model) {
    this._done(this._c.plush_swap(this._toy, ...this._image(this._other ? "model" : "other", model)));
    this._other = !this._other;
    this._model();
  }

  /** Use the last layer of one person, or with null the model's own again. @param {Uint8Array|ArrayBuffer|null} bytes */
  patch(bytes) {
    const patch = bytes === null ? [0, 0] : this._put(this._patched ? "patch" : "patch too", bytes);
    this._done(this._c.plush_patch(this._toy, ...patch));
    if (bytes !== null) this._patched = !this._patched;
  }
}
