// The page of an export: reads a toy, or a file, and shows what the model makes of it. It follows plushsense.js in one script.
// `settings` has: title, simulated, layout (as Layout.to_dict, each channel with `low` and `high` in steps), wires (other line
// formats of the same channels), gestures, reactions. The Python that each part equals is named beside it.

const $ = (id) => document.getElementById(id);
const settings = JSON.parse($("settings").textContent);
const layout = settings.layout, channels = layout.channels, period = 1000 / layout.rate_hz;

// Words: the English text is the key ------------------------------------------------------------------------------------
const LATVIAN = {
  "Toy": "Rotaļlieta", "Connect by cable": "Savienot ar kabeli", "Connect by Bluetooth": "Savienot ar Bluetooth", "Play a recording": "Atskaņot ierakstu",
  "Stop": "Apturēt", "Reactions": "Reakcijas", "green, or red if rough": "zaļas; ja rupji, sarkanas", "green, or dark if rough": "zaļas; ja rupji, tumšas", "none at all": "nekādu", "These data are simulated": "Šie dati ir simulēti", "Now": "Tagad", "Events": "Notikumi", "Save the log": "Saglabāt žurnālu",
  "Probabilities": "Varbūtības", "Signals": "Signāli", "Record frames": "Ierakstīt kadrus", "Gesture": "Žests", "Begin": "Sākt", "End and save": "Beigt un saglabāt",
  "The toy does not react to these numbers, but to the events, which are decided from them over some time.": "Rotaļlieta reaģē nevis uz šiem skaitļiem, bet uz notikumiem, par kuriem no tiem izlemj ilgākā laikā.",
  "The file stays on this computer. Put the files of one person into one folder; plushsense import reads them.": "Datne paliek šajā datorā. Viena cilvēka datnes lieciet vienā mapē; plushsense import tās nolasa.",
  "This page works without a network. It sends nothing anywhere and keeps nothing; what you save is a file on this computer.": "Šī lapa darbojas bez tīkla. Tā nekur neko nesūta un neko neglabā; tas, ko saglabājat, ir datne šajā datorā.",
  "Cable: this browser gives pages no ports. Use Chrome or Edge on a computer or Chromebook.": "Kabelis: šī pārlūkprogramma lapām nedod portus. Lietojiet Chrome vai Edge datorā vai Chromebook.",
  "Bluetooth: this browser gives pages none. Use Chrome or Edge; on iPhone and iPad, and in Firefox, there is none.": "Bluetooth: šī pārlūkprogramma lapām to nedod. Lietojiet Chrome vai Edge; iPhone un iPad, kā arī Firefox tā nav.",
  "Open this page as a file, or from an https address: only then the browser lets it use a toy.": "Atveriet šo lapu kā datni vai no https adreses: tikai tad pārlūkprogramma ļauj tai lietot rotaļlietu.",
  "Simulation: these data say nothing about a real toy.": "Simulācija: šie dati par īstu rotaļlietu neko nepasaka.",
  "Simulation: this network was trained on virtual people. What it says about a real toy proves nothing.": "Simulācija: šis tīkls ir apmācīts ar virtuāliem cilvēkiem. Tas, ko tas vēsta par īstu rotaļlietu, neko nepierāda.",
  "Not started": "Nav sākts", "Choose how the toy is connected.": "Izvēlieties, kā rotaļlieta ir pievienota.", "Connecting …": "Savienojas …",
  "Waiting for the first data of the toy.": "Gaida pirmos datus no rotaļlietas.", "Warming up": "Iesildās",
  "The network must read a few seconds before its first answer.": "Pirms pirmās atbildes tīklam jānolasa dažas sekundes.", "Sensor fault": "Sensora kļūme",
  "The sensor values cannot be trusted, so nothing is recognised. Check the toy and its cable.": "Sensoru rādījumiem nevar ticēt, tāpēc nekas netiek atpazīts. Pārbaudiet rotaļlietu un kabeli.",
  "No signal from the toy": "No rotaļlietas nav signāla", "It is connected but sends nothing. Check that it is switched on and charged.": "Tā ir pievienota, bet neko nesūta. Pārbaudiet, vai tā ir ieslēgta un uzlādēta.",
  "The toy cannot be read": "Rotaļlietu nevar nolasīt", "Nothing is happening": "Nekas nenotiek", "Not sure": "Nav drošs", "Some touch that it does not know": "Kāds pieskāriens, ko tas nepazīst",
  "A touch": "Pieskāriens", "noticed by the gate (threshold rules)": "pamanīja vārti (robežvērtību noteikumi)", "recognised by the network": "atpazina tīkls",
  "Eyes of the toy": "Rotaļlietas acis", "Eyes green": "Acis zaļas", "Eyes red": "Acis sarkanas", "Eyes off": "Acis nedeg", "purr": "murrā", "shriek": "spiedz",
  "positive": "pozitīvs", "neutral": "neitrāls", "negative": "negatīvs", "none": "nekādas", "No event yet.": "Notikumu vēl nav.", "still going on": "turpinās",
  "The signals of the toy over the last {s} seconds, one lane each": "Rotaļlietas signāli pēdējo {s} s laikā, katrs savā joslā",
  "Frames: {frames}. Unreadable lines: {bad}. Invalid values: {invalid}. Gaps: {gaps}.": "Kadri: {frames}. Nenolasāmas rindas: {bad}. Nederīgas vērtības: {invalid}. Pārtraukumi: {gaps}.",
  "The toy sends lines that cannot be read, as “{line}”: this page expects {n} whole or decimal numbers a line, at 115200 baud.": "Rotaļlieta sūta rindas, ko nevar nolasīt, piemēram, „{line}”: šī lapa gaida {n} skaitļus rindā ar ātrumu 115200 bodi.",
  "The toy went away ({why}). Switch it on or plug it in, and connect again.": "Rotaļlieta ir pazudusi ({why}). Ieslēdziet vai pievienojiet to un savienojiet vēlreiz.",
  "The toy could not be connected ({why}). Close other programs that use it, and try again.": "Rotaļlietu neizdevās savienot ({why}). Aizveriet citas programmas, kas to lieto, un mēģiniet vēlreiz.",
  "Simulated data are not recorded here, as the file could not say so: use plushsense record.": "Simulētus datus šeit neieraksta, jo datne to nevarētu pateikt: lietojiet plushsense record.",
  "No toy was chosen.": "Rotaļlieta nav izvēlēta.", "“{file}” is over.": "„{file}” ir beidzies.", "Playing “{file}”, a recording.": "Atskaņo „{file}”, ierakstu.", "Reading the toy.": "Nolasa rotaļlietu.",
  "“{file}” cannot be played: it is not a recording with the columns or lines of layout {layout}.": "„{file}” nevar atskaņot: tas nav ieraksts ar izkārtojuma {layout} slejām vai rindām.",
  "“{file}” is packed (gzip or zip): unpack it, and play the file that is in it.": "„{file}” ir saspiests (gzip vai zip): izsaiņojiet to un atskaņojiet datni, kas tajā ir.",
  "“{file}” is text in UTF-16: save it in UTF-8 with a text editor, and play that.": "„{file}” ir teksts UTF-16 kodējumā: ar teksta redaktoru saglabājiet to UTF-8 kodējumā un atskaņojiet to.",
  "“{name}” is not a toy that this page can read, as it lacks the service of the Nordic UART: connect a toy that has it.": "„{name}” nav rotaļlieta, ko šī lapa var nolasīt, jo tajā nav Nordic UART pakalpojuma: savienojiet rotaļlietu, kurai tas ir.",
  "“{file}” is larger than {mb} MB; play a part of it.": "„{file}” ir lielāks par {mb} MB; atskaņojiet daļu no tā.",
  "This browser cannot run the model: {why}": "Šī pārlūkprogramma nevar darbināt modeli: {why}", "{n} frames": "{n} kadri",
  "At rest": "Miera stāvoklī", "Back stroke": "Muguras glāstīšana", "Ear scratch": "Ausu kasīšana", "Head stroke": "Galvas glāstīšana", "Hold in hands": "Turēšana rokās", "Hold strong": "Cieša apskaušana",
  "Neck scratch": "Kakla kasīšana", "Tail hit": "Uzsitiens pie astes", "Tail pull": "Astes raušana", "Tail scratch": "Kasīšana pie astes", "Tail tap": "Viegla uzsišana pie astes",
  cap_all: "visi pieskārieni", cap_extremities: "ekstremitātes", ears: "ausis", head: "galva", neck: "kakls", proximity: "tuvums", nose: "deguns", tail: "aste", back: "mugura", belly: "vēders",
  acc_x: "paātrinājums x", acc_y: "paātrinājums y", acc_z: "paātrinājums z", x_acc: "paātrinājums x", y_acc: "paātrinājums y", z_acc: "paātrinājums z", x_gyro: "griešanās x", y_gyro: "griešanās y", z_gyro: "griešanās z",
};
let language = navigator.language.startsWith("lv") ? "lv" : "en";
const t = (text, values = {}) => ((language === "lv" && LATVIAN[text]) || text).replace(/\{(\w+)\}/g, (_, key) => values[key] ?? "");
/** The name of a gesture: of "Tail hit 2" the words are translated, the number stays. */
const named = (label) => (LATVIAN[label] ? t(label) : label.replace(/^(.*?)( \d+)?$/, (_, words, n) => t(words) + (n ?? "")));

// Lines: devices/wire.LineParser ----------------------------------------------------------------------------------------
const MOST = 2 ** 53, WHOLE = /^[+-]?\d{1,18}$/, DECIMAL = /^[+-]?(\d{1,18}(\.\d{0,18})?|\.\d{1,18})(e[+-]?\d{1,2})?$/i;
const LATIN = new TextDecoder("latin1"); // any byte is one character
const toEven = (x) => {
  const size = Math.abs(x), low = Math.floor(size), up = size - low > 0.5 || (size - low === 0.5 && low % 2 === 1);
  return Math.sign(x) * (low + up) + 0; // no negative zero
};
const whole = (field) => (WHOLE.test(field) && (field.length < 16 || (BigInt(field) <= MOST && BigInt(field) >= -MOST)) ? Number(field) + 0 : null);

class LineParser {
  /** `joining`: reading may begin in the middle of a line, so the first one is dropped. */
  constructor(joining = false) {
    Object.assign(this, { frames: 0, malformed: 0, garbage: 0, joining, pending: "", skipping: false, clock: 0, unread: "", unreadable: 0, others: 0 });
    this.use(layout.wire);
  }

  use(wire) {
    this.wire = wire;
    this.longest = Math.max(256, 40 * wire.length);
    [this.clockAt, this.delayAt] = ["device_ms", "delay_ms"].map((name) => wire.indexOf(name));
    this.at = channels.map((c) => wire.indexOf(c.name));
  }

  /** The frames that end within these bytes. */
  feed(bytes) {
    const pieces = LATIN.decode(bytes).split(/[\n\r]/), last = pieces.pop();
    const frames = pieces.map((piece) => { this.keep(piece); return this.take(); });
    this.keep(last);
    return frames.filter(Boolean);
  }

  keep(piece) {
    if (!this.skipping) this.pending += piece;
    if (this.pending.length <= this.longest) return;
    this.refuse(this.pending);
    [this.pending, this.skipping] = ["", true];
  }

  take() {
    const line = this.pending, joined = this.joining, skipped = this.skipping;
    Object.assign(this, { pending: "", joining: false, skipping: false });
    const fields = line.split(/[ ,;\t]+/).filter(Boolean);
    if (skipped || !fields.length) return null;
    const numbers = this.numbers(fields);
    if (!numbers) return this.refuse(joined ? "" : line, fields);
    this.unreadable = this.others = 0;
    if (joined) return null;
    // Without a clock, delays are added up; the first is from a frame that was not read.
    this.clock += this.frames && this.clockAt < 0 ? numbers[this.delayAt] : 0;
    if (this.clock > MOST) this.clock = 0;
    const ms = numbers[this.clockAt] ?? this.clock, values = this.at.map((at) => numbers[at]);
    this.frames++;
    this.garbage += values.some((v, i) => v < channels[i].low || v > channels[i].high);
    return { ms, values };
  }

  /** Count a malformed line. Ten of another number of numbers are of older firmware of the toy: read it from here on. */
  refuse(line, fields = []) {
    this.malformed++;
    if (line && !this.unreadable++) this.unread = line.slice(0, 100).replace(/[^ -~]/g, "?");
    const fits = settings.wires.find((wire) => wire.length === fields.length && wire.length !== this.wire.length);
    this.others = fits && fields.every((field) => DECIMAL.test(field)) ? this.others + 1 : 0;
    if (this.others >= 10 && !this.frames) this.use(fits);
    return null;
  }

  numbers(fields) {
    const { wire, clockAt, delayAt } = this;
    if (fields.length !== wire.length) return null;
    const clock = (at) => at < 0 || (fields[at][0] !== "-" && whole(fields[at]) !== null);
    if (!clock(clockAt) || !clock(delayAt) || (clockAt < 0 && whole(fields[delayAt]) > 2 ** 31)) return null;
    const numbers = wire.map((_, at) => (at === clockAt || at === delayAt ? whole(fields[at]) : 0));
    for (let i = 0; i < channels.length; i++) {
      const field = fields[this.at[i]], step = channels[i].step;
      const value = step === 1 ? whole(field) : DECIMAL.test(field) && Math.abs(Number(field) / step) <= MOST ? toEven(Number(field) / step) : null;
      if (value === null) return null;
      numbers[this.at[i]] = value;
    }
    return numbers;
  }
}

// Files: core/recorder_csv, and a toy's lines --------------------------------------------------------------------------
const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i;
const sum = (column) => column.reduce((a, b) => a + b, 0);
const cut = (line, separator) => (separator ? line.split(separator) : line.trim().split(/\s+/)).map((cell) => cell.trim());
const separatorOf = (line) => [";", ","].find((sign) => line.includes(sign));

/** Whether a clock column holds delays, as of the 14-integer firmware. */
function areDelays(column, host) {
  const sorted = [...column].sort((a, b) => a - b), n = column.length;
  if (n < 3 || sorted[0] < 0 || (sorted[n >> 1] + sorted[(n - 1) >> 1]) / 2 > 2000) return false;
  const steps = column.slice(1).map((v, i) => v - column[i]), count = (f) => steps.filter(f).length;
  if (count((s) => s <= 0) < 0.3 * steps.length || count((s) => s < 0) < 0.3 * count((s) => s > 0)) return false;
  if (!host) return true;
  const rows = column.map((_, i) => i).slice(1).filter((i) => host[i] - host[i - 1] <= 60000 && column[i] <= 60000);
  const passed = sum(rows.map((i) => host[i] - host[i - 1]));
  return Math.abs(sum(rows.map((i) => column[i])) - passed) <= Math.max(200, 0.5 * Math.abs(passed));
}

/** The columns of a file by its first line, and whether that is a header; null if it is none of this layout. */
function columnsOf(first) {
  const { columns, header } = layout.csv, cells = cut(first, separatorOf(first)), labelled = columns.at(-1) === "label";
  while (cells.length && !cells.at(-1) && !(labelled && cells.length === columns.length)) cells.pop();
  const titled = cells.length > 0 && !cells.some((cell) => NUMBER.test(cell));
  const known = new Map([["arduino delay (ms)", "delay_ms"], ...columns.map((c) => [c.toLowerCase(), c]), ...header.map((h, i) => [h.toLowerCase(), columns[i]])]);
  const keys = cells.map((cell) => known.get(cell.toLowerCase()));
  if (titled && keys.every(Boolean) && keys.length > channels.length) return { keys, titled };
  if (cells.length === columns.length) return { keys: columns, titled };
  return labelled && cells.length === columns.length - 1 ? { keys: columns.slice(0, -1), titled } : null;
}

/** {frames, malformed} of a recording or of lines as a toy sends them; null if it is neither. */
function readFile(bytes, name) {
  let text = new TextDecoder().decode(bytes).replace(/\r\n?/g, "\n").trimStart();
  if (text.slice(0, 4096).includes("\0")) return null;
  const first = text.slice(0, 1e6).split("\n", 1)[0], wires = [layout.wire, ...settings.wires];
  if (!separatorOf(first) && wires.some((wire) => wire.length === cut(first).length)) {
    const parser = new LineParser(), frames = parser.feed(bytes);
    return frames.length ? { frames, malformed: parser.malformed } : null;
  }
  // The last line of a session's stream may be cut off; a recording is named LABEL_TIME_ROWS.csv.
  if (!/.+_\d{1,18}_\d{1,12}( \(\d{1,4}\))?\.csv$/i.test(name) && text.includes("\n")) text = text.slice(0, text.lastIndexOf("\n") + 1);
  const lines = text.split("\n"), of = columnsOf(lines[0]);
  if (!of || channels.some((c) => !of.keys.includes(c.name))) return null;
  const rows = [], separator = separatorOf(lines.slice(of.titled ? 1 : 0).find((line) => line.trim()) ?? "");
  let malformed = 0;
  for (const line of of.titled ? lines.slice(1) : lines) {
    if (!line.trim()) continue;
    const cells = cut(line, separator);
    while (cells.length > of.keys.length && !cells.at(-1)) cells.pop();
    const fits = cells.length === of.keys.length && cells.every((cell, i) => of.keys[i] === "label" || (NUMBER.test(cell) && Math.abs(Number(cell)) < MOST));
    fits ? rows.push(cells.map(Number)) : malformed++;
  }
  const column = (key) => (of.keys.includes(key) ? rows.map((row) => toEven(row[of.keys.indexOf(key)])) : null);
  const host = column("host_ms");
  let clock = column("device_ms"), delays = column("delay_ms");
  if (clock && !delays && areDelays(clock, host)) [delays, clock] = [clock, null];
  let ms = delays ? -delays[0] : 0;
  clock ??= delays?.map((delay) => (ms += delay)) ?? host;
  if (!rows.length || !clock) return null;
  const at = channels.map((c) => of.keys.indexOf(c.name));
  return { malformed, frames: rows.map((row, n) => ({ ms: clock[n], host: host?.[n], values: at.map((i, c) => toEven(row[i] / channels[c].step)) })) };
}

// Reactions: live/reactions.Reactor, for the rules of the built-in profiles (an affect that has begun) -------------------
class Reactor {
  constructor() { Object.assign(this, { answered: 0, refractory: {}, quiet: -Infinity, of: "" }); }

  /** The rule that answers this change of an event at the time `s` in seconds, or undefined. */
  react(event, s) {
    const rule = (settings.reactions[$("reactions").value] ?? []).find((r) => r.affect === event.affect);
    if (!rule || event.what !== "begun" || event.number <= this.answered) return;
    this.answered = event.number;
    if (s < (this.refractory[event.affect] ?? -Infinity) || (s < this.quiet && event.affect !== this.of)) return;
    this.refractory[event.affect] = s + rule.refractory_s;
    if (rule.quiet_s > 0) [this.quiet, this.of] = [s + rule.quiet_s, event.affect];
    return rule;
  }
}

// A run: the frames of one source through the model ----------------------------------------------------------------------
const SILENT_MS = 750, SHOWN_S = 10, MOST_MB = 64, MOST_ROWS = 20000, KEPT = Math.ceil(1.2 * SHOWN_S * layout.rate_hz);
const STALE_FRAMES = 256, LONG_PAUSE_MS = 600000; // windows/clock
const bytesOf = (id) => Uint8Array.from(atob($(id).textContent.trim()), (c) => c.charCodeAt(0));
const module = WebAssembly.compile(bytesOf("module")), image = bytesOf("image");
let run = null, rows = null; // rows: of the recording of frames that goes on
const ring = { s: new Float64Array(KEPT), y: channels.map(() => new Float64Array(KEPT)), n: 0 };

/** Begin a run; `source` has: close() and, for a file, its name. */
async function begin(source) {
  const toy = await module.then((made) => open(image, made)).catch(async (cause) => { await source.close?.(); throw cause; });
  while (run && !run.over) await stop(); // another may have begun meanwhile
  const own = { source, toy, parser: new LineParser(true), reactor: new Reactor(), recent: [], follows: false, s: 0, ms: null, frames: 0, at: performance.now(), quiet: false, spans: [], log: [], eyes: "off", sound: "", until: 0 };
  toy.onEvent = (event) => change(own, event);
  run = own;
  ring.n = 0;
  for (const id of ["stop", "log", "record"]) $(id).disabled = false;
  document.body.classList.add("running"); // hides what connects
  say("message", source.file ? t("Playing “{file}”, a recording.", source) : t("Reading the toy."));
  dispatchEvent(new CustomEvent("plushsense", { detail: own }));
  navigator.wakeLock?.request("screen").catch(() => {});
  redraw();
  return own;
}

async function stop(sentence = "") {
  const old = run;
  if (!old || old.over) return;
  old.over = true;
  old.toy.silence(); // ends what is going on
  $("stop").disabled = $("record").disabled = true;
  document.body.classList.remove("running");
  if (rows) record();
  say("message", sentence);
  redraw();
  await Promise.resolve(old.source.close?.()).catch(() => {});
}

/** Rules 1 and 4 of windows/clock: with the first frame after a reboot, sensors that calibrate themselves begin anew. */
function noticeReboot(own, ms, host) {
  const { recent } = own, step = ms - (recent.at(-1)?.ms ?? ms), gap = layout.gap_ms;
  if (step < 0 && step >= -gap) return;
  const ordered = step >= 0 && step <= gap, leftOut = own.follows && !ordered;
  own.follows = !leftOut;
  if (leftOut) return;
  const paused = host - recent[0]?.host;
  if (!ordered && paused >= LONG_PAUSE_MS && 2 * (ms - recent[0].ms) < paused) own.toy.recalibrate();
  if (recent.push({ ms, host }) > STALE_FRAMES) recent.shift();
}

function take(own, frames) {
  if (own.over || !frames.length) return;
  const now = Date.now();
  for (const { ms, values, host = now } of frames) {
    const step = ms - (own.ms ?? ms);
    [own.s, own.ms] = [own.s + (step < 0 ? period : step) / 1000, ms];
    noticeReboot(own, ms, host);
    own.toy.push(values, ms);
    ring.s[ring.n % KEPT] = own.s;
    for (let i = 0; i < values.length; i++) ring.y[i][ring.n % KEPT] = values[i];
    ring.n++;
    rows?.push(row(ms, values, host));
  }
  Object.assign(own, { frames: own.frames + frames.length, at: performance.now(), quiet: false });
  draw();
}

/** An event has begun, has its name, or has ended. */
function change(own, event) {
  const s = (ms) => own.s - (((own.ms - ms) % 2 ** 32) + 2 ** 32) % 2 ** 32 / 1000;
  let span = own.spans.at(-1);
  if (event.what === "begun") own.spans.push((span = { number: event.number, from: s(event.since_ms), to: null, source: event.source }));
  else if (event.what === "ended") span.to = s(event.since_ms);
  Object.assign(span, { affect: event.affect, name: event.name });
  const rule = own.reactor.react(event, s(event.ms));
  if (rule) Object.assign(own, { eyes: rule.eyes, sound: rule.sound, until: s(event.ms) + rule.seconds });
  own.log.push([new Date().toISOString(), s(event.ms).toFixed(3), event.what, event.number, event.name ?? "", event.affect, event.source, rule ? `${rule.eyes} ${rule.sound}` : ""]);
  if (own.spans.length > 50) own.spans.shift();
  if (own.log.length > MOST_ROWS) own.log.shift();
  if (event.what !== "ended") speak(`${event.name ? named(event.name) : t("A touch")}, ${t(event.affect)}`);
  listed = false;
}

// Frames that wait when this runs late, as in a tab in the background, must not count as silence: look again after them.
setInterval(() => {
  const own = run, at = own?.at;
  if (!own || own.over || own.quiet || own.source.file || performance.now() - at < SILENT_MS) return;
  setTimeout(() => {
    if (own !== run || own.over || own.at !== at) return;
    own.quiet = true;
    own.toy.silence();
    draw();
  }, 100);
}, 250);

// Sources ------------------------------------------------------------------------------------------------------------
const UART = "6e400001-b5a3-f393-e0a9-e50e24dcca9e", TX = "6e400003-b5a3-f393-e0a9-e50e24dcca9e"; // devices/ble
const gone = (own, why) => own === run && stop(t("The toy went away ({why}). Switch it on or plug it in, and connect again.", { why }));
const feed = (own, bytes) => { take(own, own.parser.feed(bytes)); if (own.parser.unreadable) draw(); };

async function fromSerial() {
  const port = await navigator.serial.requestPort();
  await port.open({ baudRate: 115200, bufferSize: 1 << 20 }); // some minutes, should the page not get to read
  await port.setSignals?.({ dataTerminalReady: true, requestToSend: true }).catch(() => {}); // as pyserial does
  let reader, why = "", broken = null;
  const own = await begin({ close: async () => { await reader?.cancel().catch(() => {}); await port.close(); } });
  for (let more = true; more && port.readable && port.readable !== broken && !own.over; ) {
    reader = (broken = port.readable).getReader();
    try {
      for (let got; !(got = await reader.read()).done; ) feed(own, got.value);
      more = false;
    } catch (cause) {
      // A line was disturbed or bytes are lost: the port goes on with a new reader, unless it is gone.
      why = cause.message;
      Object.assign(own.parser, { pending: "", joining: true });
    } finally {
      reader.releaseLock();
    }
  }
  if (!own.over) await gone(own, why || "disconnected");
}

async function fromBluetooth() {
  const filters = [{ services: [UART] }, ...["Plush", "plush", "Toy", "toy", "Teddy", "teddy", "Bear", "bear"].map((namePrefix) => ({ namePrefix }))];
  const device = await navigator.bluetooth.requestDevice({ filters, optionalServices: [UART] });
  say("message", t("Connecting …"));
  const tx = await device.gatt.connect().then((server) => server.getPrimaryService(UART)).then((service) => service.getCharacteristic(TX)).catch((cause) => {
    device.gatt.disconnect(); // or it stays connected, and other programs cannot find it
    if (cause.name !== "NotFoundError") throw cause;
  });
  if (!tx) return say("message", t("“{name}” is not a toy that this page can read, as it lacks the service of the Nordic UART: connect a toy that has it.", device));
  const own = await begin({ close: () => device.gatt.disconnect() });
  device.addEventListener("gattserverdisconnected", () => own.over || gone(own, "disconnected"), { once: true });
  tx.addEventListener("characteristicvaluechanged", ({ target: { value } }) => feed(own, new Uint8Array(value.buffer, value.byteOffset, value.byteLength)));
  await tx.startNotifications().catch((cause) => gone(own, cause.message));
}

const PACKED = "“{file}” is packed (gzip or zip): unpack it, and play the file that is in it.", UTF_16 = "“{file}” is text in UTF-16: save it in UTF-8 with a text editor, and play that.";
const WRONG = { 0x1f8b: PACKED, 0x504b: PACKED, 0xfffe: UTF_16, 0xfeff: UTF_16 }; // by the first two bytes

/** Play a file at the pace of the toy's clock: devices/base.Pacer. */
async function fromFile(chosen) {
  if (chosen.size > MOST_MB << 20) return say("message", t("“{file}” is larger than {mb} MB; play a part of it.", { file: chosen.name, mb: MOST_MB }));
  const bytes = new Uint8Array(await chosen.arrayBuffer()), wrong = WRONG[bytes[0] << 8 | bytes[1]];
  if (wrong) return say("message", t(wrong, { file: chosen.name }));
  const read = readFile(bytes, chosen.name);
  if (!read) return say("message", t("“{file}” cannot be played: it is not a recording with the columns or lines of layout {layout}.", { file: chosen.name, layout: layout.name }));
  if (/simul|virtual/i.test(chosen.name)) $("simulated").checked = true;
  const own = await begin({ file: chosen.name }), { frames, malformed } = read;
  own.parser.malformed = malformed;
  let at = 0, due = 0;
  const began = performance.now();
  const play = () => {
    const from = at, now = performance.now() - began;
    for (; at < frames.length; at++) {
      const step = at ? frames[at].ms - frames[at - 1].ms : 0, next = due + (step >= 0 && step <= 2000 ? step : 0);
      if (next > now) break;
      due = next;
    }
    take(own, frames.slice(from, at));
    if (at < frames.length) own.over || setTimeout(play, 20);
    else if (!own.over) stop(t("“{file}” is over.", { file: chosen.name }));
  };
  play();
}

const attempt = (connect) => async ({ target }) => {
  target.disabled = true; // until the source is closed: a second press must not open it twice
  try {
    await connect();
  } catch (cause) {
    const sentence = cause instanceof PlushError ? "This browser cannot run the model: {why}" : "The toy could not be connected ({why}). Close other programs that use it, and try again.";
    say("message", t(cause.name === "NotFoundError" ? "No toy was chosen." : sentence, { why: cause.message }));
  } finally {
    target.disabled = false;
  }
};

// What is saved -------------------------------------------------------------------------------------------------------
function save(name, lines) {
  const a = document.createElement("a");
  a.href = URL.createObjectURL(new Blob([lines.join("\n"), "\n"], { type: "text/csv" }));
  a.download = name;
  a.click();
  setTimeout(() => URL.revokeObjectURL(a.href), 1000);
}

const quoted = (cell) => (/[;"\n]/.test(cell) ? `"${cell.replaceAll('"', '""')}"` : cell);

/** A row as the recorder writes it: core/recorder_csv.format_rows. */
function row(ms, values, host) {
  const clocks = { host_ms: host, device_ms: ms, delay_ms: rows.ms === undefined ? 0 : ms - rows.ms, label: rows.label.replace(/[;,]/g, "_") };
  rows.ms = ms;
  return layout.csv.columns.map((key) => {
    if (key in clocks) return clocks[key];
    const at = channels.findIndex((c) => c.name === key), step = channels[at].step;
    return step === 1 ? values[at] : (values[at] * step).toFixed(Math.max(0, -Math.floor(Math.log10(step))));
  }).join(layout.csv.separator);
}

function record() {
  if (!rows && $("simulated").checked) return say("message", t("Simulated data are not recorded here, as the file could not say so: use plushsense record."));
  if (!rows) rows = Object.assign([], { label: $("gesture").value });
  else {
    const name = rows.label.replace(/[\\/:*?"<>|()\x00-\x1f]/g, "_").replace(/^[ .]+|[ .]+$/g, "") || "_"; // recording_filename
    if (rows.length) save(`${name}_${Date.now()}_${rows.length}.csv`, [layout.csv.header.join(layout.csv.separator), ...rows]);
    rows = null;
  }
  $("record").textContent = t(rows ? "End and save" : "Begin");
  say("rows", "");
}

// What is shown --------------------------------------------------------------------------------------------------------
const SIGNS = { positive: "+", neutral: "○", negative: "−", none: "·" };
const say = (id, text) => { if ($(id).textContent !== text) $(id).textContent = text; };
const put = (id, name, value) => { if ($(id).getAttribute(name) !== value) $(id).setAttribute(name, value); };
const make = (tag, text = "", values = {}) => Object.assign(document.createElement(tag), { textContent: text }, values);
const LANE = 44, ink = {}, shown = new MessageChannel();
let pen = null, inSight = false, due = 0, cost = 0.4, pictures = 0, textAt = 0, listed = false, drawn = 0, ranges = [], rangedAt = 0, spoken = null, speaking = 0, told = 0;

/** At most one sentence in 2.5 seconds, always the newest. */
function speak(text) {
  spoken = text;
  if (speaking) return;
  say("spoken", spoken);
  speaking = setTimeout(() => { speaking = 0; if (spoken !== $("spoken").textContent) speak(spoken); }, 2500);
}

/** The line about what is going on, and what it means. */
function situation() {
  const span = run?.spans.at(-1);
  if (!run || run.over) return ["Not started", "Choose how the toy is connected."];
  if (run.parser.unreadable && (run.quiet || !run.frames)) return ["The toy cannot be read"];
  if (run.quiet) return ["No signal from the toy", "It is connected but sends nothing. Check that it is switched on and charged."];
  if (!run.frames) return ["Connecting …", "Waiting for the first data of the toy."];
  const answer = run.toy.answer();
  if (answer.state === "fault") return ["Sensor fault", "The sensor values cannot be trusted, so nothing is recognised. Check the toy and its cable."];
  if (span && span.to === null) return [span.name ? named(span.name) : "A touch", span.source === "gate" ? "noticed by the gate (threshold rules)" : "recognised by the network", span.affect];
  if (answer.state === "warming") return ["Warming up", "The network must read a few seconds before its first answer."];
  return [{ idle: "Nothing is happening", unknown: "Some touch that it does not know" }[answer.kind] ?? "Not sure", ""];
}

function showTexts() {
  const [state, about = "", affect] = situation(), own = run && !run.over ? run : null;
  say("state", t(state));
  say("about", state === "The toy cannot be read" ? t("The toy sends lines that cannot be read, as “{line}”: this page expects {n} whole or decimal numbers a line, at 115200 baud.", { line: own.parser.unread, n: own.parser.wire.length }) : t(about));
  $("affect").toggleAttribute("hidden", !affect);
  if (affect) { say("affect", `${SIGNS[affect]} ${t(affect)}`); put("affect", "data-affect", affect); }
  const eyes = own && own.s < own.until && !own.quiet ? own.eyes : "off", sound = eyes !== "off" && own.sound ? ` · ♪ ${t(own.sound)}` : "";
  put("face", "data-eyes", eyes);
  say("reaction", t(`Eyes ${eyes}`) + sound);
  put("face", "aria-label", `${t("Eyes of the toy")}: ${t(`Eyes ${eyes}`)}`);
  const shares = own ? run.toy.probabilities() : [];
  for (const [i, li] of [...$("bars").children].entries()) {
    const percent = own ? Math.round(100 * shares[i]) : null;
    if (li.percent === percent) continue;
    li.percent = percent;
    li.querySelector("b").style.transform = `scaleX(${(percent ?? 0) / 100})`;
    li.lastChild.textContent = percent === null ? "–" : `${percent} %`;
  }
  if (rows) say("rows", t("{n} frames", { n: rows.length }));
  if (run && ++told % 2 === 0) {
    const n = run.toy.counts();
    say("counts", t("Frames: {frames}. Unreadable lines: {bad}. Invalid values: {invalid}. Gaps: {gaps}.", { frames: run.frames, bad: run.parser.malformed, invalid: n.invalid, gaps: n.restarts }));
  }
  const marks = [$("simulated").checked && "Simulation: these data say nothing about a real toy.", settings.simulated && "Simulation: this network was trained on virtual people. What it says about a real toy proves nothing."];
  say("mark", marks.filter(Boolean).map((text) => t(text)).join(" "));
  $("mark").toggleAttribute("hidden", !$("mark").textContent);
  if (!listed) showEvents();
}

function showEvents() {
  listed = true;
  const seconds = (v) => `${v.toLocaleString(language, { minimumFractionDigits: 1, maximumFractionDigits: 1 })} s`, spans = run?.spans.slice(-20).reverse() ?? [];
  $("events").replaceChildren(...(spans.length ? spans : [null]).map((span) => {
    if (!span) return make("li", t("No event yet."), { className: "dim" });
    const li = make("li"), badge = make("b", `${SIGNS[span.affect]} ${t(span.affect)}`, { className: "badge" });
    badge.dataset.affect = span.affect;
    li.append(make("span", seconds(span.from)), badge, make("b", span.name ? named(span.name) : t("A touch")), make("span", span.to === null ? t("still going on") : seconds(span.to - span.from)));
    return li;
  }));
}

/**
 * Show what has come: signals in sight 12 to 60 times a second, as often as takes 1 % of a core here, a third of what it takes in all;
 * texts twice a second and with each event. It is drawn as data arrive, and not with a frame of the screen: a canvas that is `desynchronized`
 * needs none, and without a graphics card a frame takes three times as long.
 */
function draw() {
  const now = performance.now();
  if (document.hidden || now < due) return;
  due = Math.max(due, now - 15) + Math.min(Math.max(100 * cost, 16.6), 80);
  drawSignals(now);
  if (++pictures % 16 === 0) shown.port2.postMessage(now); // arrives when the browser is done with the picture
  if (listed && now - textAt < 500) return;
  textAt = now;
  showTexts();
}
shown.port1.onmessage = ({ data: began }) => (cost += (performance.now() - began - cost) / 4);
setInterval(draw, 500); // what data no longer change

function redraw() {
  for (const name of ["back", "trace"]) ink[name] = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
  [ranges, drawn, told, listed, due] = [[], 0, 1, false, 0];
  draw();
}

/** New samples are drawn over the oldest ones, from left to right: that costs less than to move the picture. */
function drawSignals(now) {
  const canvas = $("canvas"), ratio = devicePixelRatio || 1, [wide, high] = [canvas.clientWidth, LANE * channels.length];
  if (canvas.width !== Math.round(wide * ratio) || canvas.height !== Math.round(high * ratio)) {
    [canvas.width, canvas.height, drawn] = [Math.round(wide * ratio), Math.round(high * ratio), 0];
    canvas.style.height = `${high}px`;
  }
  if (!inSight) return;
  if (ring.n && (!drawn || now - rangedAt > 1000)) setRanges(now);
  if (ring.n === drawn) return;
  const c = (pen ??= canvas.getContext("2d", { alpha: false, desynchronized: true })), last = (ring.n - 1) % KEPT, x = (k) => ((ring.s[k % KEPT] % SHOWN_S) / SHOWN_S) * wide;
  let first = Math.max(0, ring.n - KEPT, drawn - 1);
  // All anew where the end of the picture or a gap is passed.
  if (!drawn || x(last) < x(first) || ring.s[last] - ring.s[first % KEPT] > 1) [drawn, first] = [0, Math.max(0, ring.n - KEPT)];
  while (ring.s[first % KEPT] < ring.s[last] - 0.98 * SHOWN_S) first++;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  [c.fillStyle, c.strokeStyle] = [ink.back, ink.trace];
  c.fillRect(drawn ? x(first) + 1 : 0, 0, drawn ? x(last) - x(first) + 16 : wide, high);
  c.beginPath();
  for (let i = 0; i < channels.length; i++) {
    const [low, top] = ranges[i], values = ring.y[i];
    for (let k = first; k < ring.n; k++) {
      const at = x(k), y = LANE * (i + 1) - 3 - ((values[k % KEPT] - low) / (top - low)) * (LANE - 6);
      // A gap in the clock of the toy is a gap in the line.
      if (k === first || at < x(k - 1) || ring.s[k % KEPT] - ring.s[(k - 1) % KEPT] > 0.3) c.moveTo(at, y);
      else c.lineTo(at, y);
    }
  }
  c.stroke();
  drawn = ring.n;
}

/** A lane shows many times its noise, so that it is flat at rest; it widens at once, and narrows when its signal has long been small. */
function setRanges(now) {
  const from = Math.max(0, ring.n - KEPT);
  rangedAt = now;
  for (const [i, y] of ring.y.entries()) {
    let [low, top, moved] = [Infinity, -Infinity, 0];
    for (let k = from; k < ring.n; k++) {
      const v = y[k % KEPT];
      [low, top, moved] = [Math.min(low, v), Math.max(top, v), moved + (k > from ? Math.abs(v - y[(k - 1) % KEPT]) : 0)];
    }
    const room = Math.max(4, (10 * moved) / Math.max(1, ring.n - from), 0.55 * (top - low)), old = ranges[i];
    if (!old || low < old[0] || top > old[1] || old[1] - old[0] > 6 * room) [ranges[i], drawn] = [[(low + top) / 2 - room, (low + top) / 2 + room], 0];
  }
}

function speakLanguage(chosen) {
  language = document.documentElement.lang = chosen;
  for (const node of document.querySelectorAll("[data-t]")) node.textContent = t((node.english ??= node.textContent));
  for (const node of document.querySelectorAll("[data-language]")) node.setAttribute("aria-pressed", node.dataset.language === chosen);
  const hints = [!isSecureContext && "Open this page as a file, or from an https address: only then the browser lets it use a toy.",
    !navigator.serial && "Cable: this browser gives pages no ports. Use Chrome or Edge on a computer or Chromebook.",
    !navigator.bluetooth && "Bluetooth: this browser gives pages none. Use Chrome or Edge; on iPhone and iPad, and in Firefox, there is none."];
  say("without", hints.filter(Boolean).map((text) => t(text)).join(" "));
  $("canvas").setAttribute("aria-label", t("The signals of the toy over the last {s} seconds, one lane each", { s: SHOWN_S }));
  $("lanes").replaceChildren(...channels.map((c) => make("li", t(c.name))));
  $("bars").replaceChildren(...settings.gestures.map(({ label }) => {
    const li = make("li"), bar = make("i");
    bar.append(make("b"));
    bar.ariaHidden = "true";
    li.append(make("span", named(label)), bar, make("span", "–"));
    return li;
  }));
  const picked = $("gesture").selectedIndex;
  $("gesture").replaceChildren(...settings.gestures.map(({ label }) => make("option", named(label), { value: label })));
  $("gesture").selectedIndex = Math.max(0, picked);
  if (rows) $("record").textContent = t("End and save");
  redraw();
}

for (const [id, connect] of [["serial", fromSerial], ["bluetooth", fromBluetooth]]) {
  $(id).disabled = !navigator[id];
  $(id).addEventListener("click", attempt(connect));
}
$("open").addEventListener("click", () => $("file").click());
$("file").addEventListener("change", attempt(async () => { const [chosen] = $("file").files; $("file").value = ""; if (chosen) await fromFile(chosen); }));
$("stop").addEventListener("click", () => stop());
$("simulated").addEventListener("change", redraw);
$("record").addEventListener("click", record);
$("log").addEventListener("click", () => save(`plushsense-${$("mark").hidden ? "" : "simulated-"}${new Date().toISOString().slice(0, 19).replace(/:/g, "")}.csv`,
  [["time", "t_s", "what", "number", "gesture", "affect", "source", "reaction"], ...run.log].map((cells) => cells.map(quoted).join(";"))));
for (const node of document.querySelectorAll("[data-language]")) node.addEventListener("click", () => speakLanguage(node.dataset.language));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
// Nothing was drawn meanwhile.
document.addEventListener("visibilitychange", redraw);
new IntersectionObserver((all) => { inSight = all.at(-1).isIntersecting; redraw(); }).observe($("canvas"));
addEventListener("resize", draw);
say("model", settings.title);
window.plushPage = { LineParser, readFile, named, t, get run() { return run; } };
speakLanguage(language);
