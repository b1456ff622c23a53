// Run a module in Node, by way of plushsense.js, as c/harness.c runs the library on a chip: the same cases come from
// standard input, and the same rows go to standard output. Arguments: the folder of the two files, the model, and "time"
// to write instead what a step of the first frames takes.
import { readFileSync, writeSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, image, what] = process.argv.slice(2);
const { open, PlushError, STATES, AFFECTS, KINDS, WHATS, SOURCES } = await import(pathToFileURL(`${folder}/plushsense.js`));
const END = 0, SILENCE = 1, PATCH = 2, PRIME = 3, SENSITIVITY = 4, RECALIBRATE = 5;
const module = await WebAssembly.compile(readFileSync(`${folder}/plushsense.wasm`));
const bytes = readFileSync(0);
const cases = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
const rows = [];
let at = 0;

const next = () => cases.getUint32((at += 4) - 4, true);

function nextBytes(n) {
  const start = at;
  at += 4 * Math.ceil(n / 4);
  return bytes.subarray(start, start + n);
}

function write(text) {
  for (let done = 0; done < text.length; ) done += writeSync(1, text, done);
}

async function run() {
  const own = next();
  const toy = await open(own ? nextBytes(own) : readFileSync(image), module);
  const classes = toy.names.length;
  let frame = 0, ms = 0, due = 0, told = 0;

  function row(kind, when, what, numbers = []) {
    const c = toy.counts();
    const counts = [c.restarts, c.invalid, c.bad_stamps, c.interpolated, c.interval, Number(c.sparse)];
    const zeros = Array(2 * classes - numbers.length).fill(0);
    rows.push(...[kind, frame, when, ...what, ...counts, ...numbers, ...zeros]);
  }
  const reading = () => [(ms = next()), Array.from({ length: toy.channels }, () => next() | 0)];
  toy.onAnswer = (a) => {
    const { logits, smooth } = a.state === "tracking" ? toy.numbers() : { logits: [], smooth: [] };
    const gesture = [a.gesture, AFFECTS.indexOf(a.affect), a.confidence * 32768, KINDS.indexOf(a.kind), a.known];
    row(0, a.ms, [a.sample, STATES.indexOf(a.state), ...gesture], [...logits, ...smooth]);
    told++;
  };
  toy.onEvent = (e) => {
    const rest = [AFFECTS.indexOf(e.affect), SOURCES.indexOf(e.source), e.since_ms, 0];
    row(1, e.ms, [e.number, WHATS.indexOf(e.what), e.gesture ?? 255, ...rest]);
  };
  function push() {
    const before = [toy.answer().state === "fault", toy.counts().suspect];
    const [when, values] = reading();
    due += toy.push(values, when);
    const { state, sample } = toy.answer(), { suspect, faults } = toy.counts();
    if (before[0] === (state === "fault") && before[1] === suspect) return;
    // The answer is told at the end of the step.
    const tracking = state !== "fault" && sample >= toy.span;
    row(2, when, [faults, tracking ? 1 : STATES.indexOf(state), Number(suspect), 0, 0, 0, 0]);
  }
  function patch() {
    const n = next();
    let status = 0;
    try {
      toy.patch(n ? nextBytes(n) : null);
    } catch (error) {
      if (!(error instanceof PlushError)) throw error;
      status = error.status;
    }
    row(3, ms, [status, 0, 0, 0, 0, 0, 0]);
  }
  function prime() {
    const before = toy.counts().answers, [when, values] = reading();
    toy.prime(values, when);
    due += toy.counts().answers - before;
  }
  for (;;) {
    for (let n = next(); n > 0; n--, frame++) push();
    const action = next();
    frame--;
    if (action === SILENCE) toy.silence();
    else if (action === PATCH) patch();
    else if (action === PRIME) prime();
    else if (action === SENSITIVITY) toy.sensitivity = next() | 0;
    else if (action === RECALIBRATE) toy.recalibrate();
    frame++;
    if (action === END) break;
  }
  if (due !== told || toy.counts().answers !== told) throw new Error("push() counts other answers than onAnswer saw");
}

// The best of several passes, as the engine compiles the module anew while it runs.
async function time() {
  let best = Infinity, bytes;
  for (let pass = 0; pass < 5; pass++) {
    const toy = await open(readFileSync(image), module);
    at = 4;
    const frames = Array.from({ length: next() }, () => [next(), Array.from({ length: toy.channels }, () => next() | 0)]);
    const begin = frames.findIndex(([ms, values]) => toy.push(values, ms) && toy.answer().state === "tracking") + 1;
    const began = performance.now();
    let steps = 0;
    for (let n = begin; n < frames.length; n++) steps += toy.push(frames[n][1], frames[n][0]);
    best = Math.min(best, ((performance.now() - began) * 1000) / steps);
    bytes = toy.bytes;
  }
  write(Buffer.from(JSON.stringify({ step_us: best, memory_bytes: bytes })));
}

if (what === "time") await time();
else {
  while (at < bytes.length) await run();
  write(new Uint8Array(Int32Array.from(rows).buffer));
}
