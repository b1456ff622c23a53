// Situation, eyes, time line, probabilities and signals of a live toy. `scene` sets the whole state, `update` adds changes.
// Drawing waits for the next frame of the screen, so that it never falls behind.

const el = (tag, cls, text) => {
  const e = document.createElement(tag);
  if (cls) e.className = cls;
  if (text !== undefined) e.textContent = text;
  return e;
};
const say = (node, text) => { if (node.textContent !== text) node.textContent = text; };
const fill = (text, values) => text.replace(/\{(\w+)\}/g, (_, key) => values[key]);
const SPOKEN_MS = 2500, KEPT_DELAYS = 600;
const STRIP = 96, DID = 40; // height of the time line in pixels, and of the row of what the virtual person did
const NARROW = 700;

const EYES = {
  // Round; narrowed under slanted brows; closed: they differ in shape as well as in colour.
  green: `<g class="lv-eye-light"><circle cx="60" cy="58" r="26" fill="#0f7a4d"/><circle cx="140" cy="58" r="26" fill="#0f7a4d"/>
    <circle cx="60" cy="58" r="16" fill="#5df2ae"/><circle cx="140" cy="58" r="16" fill="#5df2ae"/>
    <circle cx="66" cy="51" r="5" fill="#fff"/><circle cx="146" cy="51" r="5" fill="#fff"/></g>
    <path d="M38 24 Q60 10 82 24 M118 24 Q140 10 162 24" fill="none" stroke="#5b3b22" stroke-width="6" stroke-linecap="round"/>
    <path d="M82 104 Q100 118 118 104" fill="none" stroke="#3a2413" stroke-width="5" stroke-linecap="round"/>`,
  red: `<g class="lv-eye-light"><path d="M34 52 L86 66 A27 20 0 0 1 34 62 Z" fill="#8a1500"/><path d="M166 52 L114 66 A27 20 0 0 0 166 62 Z" fill="#8a1500"/>
    <circle cx="60" cy="67" r="9" fill="#ff6a4d"/><circle cx="140" cy="67" r="9" fill="#ff6a4d"/></g>
    <path d="M32 34 L88 54 M168 34 L112 54" fill="none" stroke="#5b3b22" stroke-width="8" stroke-linecap="round"/>
    <path d="M82 112 Q100 98 118 112" fill="none" stroke="#3a2413" stroke-width="5" stroke-linecap="round"/>`,
  off: `<path d="M34 60 Q60 72 86 60 M114 60 Q140 72 166 60" fill="none" stroke="#3a2413" stroke-width="6" stroke-linecap="round"/>
    <path d="M86 108 L114 108" fill="none" stroke="#3a2413" stroke-width="5" stroke-linecap="round"/>`,
};
const QUIET = ["event", "nothing", "unsure", "unknown"]; // not announced: events have their own sentence
const face = (eyes) => `<svg viewBox="0 0 200 132" aria-hidden="true" focusable="false">
  <ellipse cx="26" cy="16" rx="22" ry="16" fill="#9c6a3d"/><ellipse cx="174" cy="16" rx="22" ry="16" fill="#9c6a3d"/>
  <rect x="10" y="6" width="180" height="122" rx="58" fill="#c08a55"/>${EYES[eyes] || EYES.off}
  <ellipse cx="100" cy="88" rx="10" ry="7" fill="#3a2413"/></svg>`;

const CSS = `
.lv { display: grid; gap: 16px; grid-template-columns: minmax(0, 1fr) minmax(0, 1.25fr); width: 100%; }
.lv > section { border: 1px solid var(--ps-line); border-radius: 10px; padding: 12px 14px; min-width: 0; }
.lv [hidden] { display: none; } .lv h2 { margin-bottom: 8px; } .lv .lv-wide { grid-column: 1 / -1; }
.lv summary { cursor: pointer; } .lv summary h2 { display: inline; margin: 0; }
.lv-check { display: inline-flex; align-items: center; gap: 8px; min-height: 44px; cursor: pointer; } .lv-check input { width: 24px; height: 24px; }
.lv canvas { display: block; width: 100%; margin-top: 8px; }
.lv-now { display: grid; gap: 16px 24px; grid-template-columns: minmax(0, 1.25fr) minmax(0, 1fr); align-items: start; }
.lv-top { display: flex; gap: 20px; align-items: center; min-width: 0; } .lv-top > :last-child { min-width: 0; }
.lv-face { width: clamp(120px, 17vw, 230px); flex: none; } .lv-face svg { display: block; width: 100%; }
.lv-line { font-size: clamp(1.45rem, 2.6vw, 2.1rem); line-height: 1.25; font-weight: 600; overflow-wrap: anywhere; }
.lv-badge { display: inline-block; color: #fff; font-weight: 600; border-radius: 6px; padding: 1px 9px; }
.lv-sure { font-weight: 600; font-size: 1.15rem; margin-left: .5em; font-variant-numeric: tabular-nums; }
.lv-more { min-height: 1.5em; } .lv-warn { border-left: 4px solid #b45309; padding-left: 10px; margin-top: 4px; } .lv-did { border-left: 4px solid var(--ps-line); padding-left: 10px; margin-top: 8px; }
.lv-group h3 { font-size: 1rem; line-height: 1.4rem; font-weight: 600; margin: 0; }
.lv-group { margin-bottom: 8px; } .lv ul, .lv ol { list-style: none; margin: 0; padding: 0; }
.lv-bar { display: grid; grid-template-columns: minmax(7em, 11em) 1fr 3.2em; gap: 8px; align-items: center; line-height: 1.35rem; }
.lv-bar > i { display: block; height: 12px; background: var(--ps-soft); border-radius: 4px; overflow: hidden; border: 1px solid var(--ps-line); }
.lv-bar > i > b { display: block; height: 100%; width: 100%; transform: scaleX(0); transform-origin: left; }
.lv-bar > span:last-child { text-align: right; font-variant-numeric: tabular-nums; }
.lv-bar.lv-best > span { font-weight: 700; }
.lv-list { max-height: 168px; overflow-y: auto; } .lv-list li { display: flex; gap: 2px 10px; flex-wrap: wrap; padding: 3px 0; border-bottom: 1px solid var(--ps-line); }
.lv-list li > :nth-child(1) { min-width: 5.2em; font-variant-numeric: tabular-nums; color: var(--ps-dim); }
.lv-dim { color: var(--ps-dim); } .lv-hidden { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); white-space: nowrap; }
@media (max-width: 900px) { .lv, .lv-now { grid-template-columns: minmax(0, 1fr); } .lv { gap: 12px; } }
@media (max-width: 500px) { .lv > section { padding: 10px; } .lv-top { gap: 12px; } .lv-face { width: 116px; } }
@media (prefers-reduced-motion: no-preference) {
  .lv-face[data-eyes=green] .lv-eye-light { animation: lv-glow 1.1s ease-in-out infinite alternate; }
  .lv-face[data-eyes=red] .lv-eye-light { animation: lv-glow .5s ease-in-out infinite alternate; } }
@keyframes lv-glow { from { opacity: .75 } to { opacity: 1 } }`;

export default {
  // The slots are moved beside the current event, and below the time line.
  template: '<div><div ref="beside"><slot></slot></div><div ref="log"><slot name="log"></slot></div></div>',
  props: { words: Object, gestures: Object, names: Object, affects: Object, signs: Object, colours: Object, lines: Array, locale: String, sameClock: Boolean, start: Object },
  mounted() {
    if (!document.getElementById("lv-css")) {
      const css = el("style", "", CSS);
      css.id = "lv-css";
      document.head.append(css);
    }
    this.stats = window.plushsenseLive = { updates: 0, drawn: 0, drawMs: 0, samples: 0, scenes: 0, delays: [], painted: [] };
    // Created once, because a formatter is expensive.
    this.digits = new Intl.NumberFormat(this.locale, { maximumFractionDigits: 2 });
    this.build();
    this.scene(this.start);
    this.resizer = new ResizeObserver(() => {
      // A canvas is cleared when its size changes: draw it in the same frame.
      if (this.$el.clientWidth !== this.wide) { this.size(); this.paint(); }
    });
    this.resizer.observe(this.$el);
    this.lights = new MutationObserver(() => { this.inks(); this.draw(); });
    this.lights.observe(document.body, { attributes: true, attributeFilter: ["class"] });
    this.seen = () => this.$emit("visible", { on: !document.hidden });
    document.addEventListener("visibilitychange", this.seen);
    if (document.hidden) this.seen();
    this.beat = setInterval(() => this.tell(), 1000);
  },
  beforeUnmount() {
    this.resizer?.disconnect();
    this.lights?.disconnect();
    document.removeEventListener("visibilitychange", this.seen);
    clearInterval(this.beat);
    cancelAnimationFrame(this.frame);
    this.gone = true;
  },
  methods: {
    // Elements ---------------------------------------------------------------------------------------------------
    build() {
      const w = this.words, root = el("div", "lv"), n = (this.n = {});
      const section = (title, cls, name) => {
        const s = el("section", cls), h = el("h2", "", title);
        s.dataset.test = name;
        h.id = `lv-h-${name}`;
        s.setAttribute("aria-labelledby", h.id);
        s.append(h);
        root.append(s);
        return s;
      };
      const folding = (parent, open) => {
        const box = el("details"), head = el("summary");
        box.open = open;
        head.append(parent.querySelector("h2"));
        box.append(head);
        parent.append(box);
        box.addEventListener("toggle", () => { this.listed = false; this.size(); this.paint(); });
        return box;
      };
      const now = section(w.now, "lv-wide", "now"), grid = el("div", "lv-now"), top = el("div", "lv-top"), texts = el("div");
      now.querySelector("h2").className = "lv-hidden";
      n.face = el("div", "lv-face");
      n.face.dataset.test = "eyes";
      n.face.setAttribute("role", "img");
      n.state = el("div", "lv-line");
      n.state.dataset.test = "state";
      n.badge = el("span", "lv-badge");
      n.badge.dataset.test = "affect";
      n.sure = el("span", "lv-sure");
      n.sure.dataset.test = "sure";
      n.about = el("div", "lv-dim lv-more");
      n.about.dataset.test = "about";
      n.warnings = el("div", "lv-warn");
      n.warnings.dataset.test = "warnings";
      n.warnings.setAttribute("role", "status");
      n.eyes = el("div", "lv-more");
      n.eyes.dataset.test = "reaction";
      n.did = el("div", "lv-did");
      n.did.dataset.test = "really";
      const affect = el("div");
      affect.append(n.badge, n.sure);
      texts.append(n.state, affect, n.about, n.warnings, n.eyes, n.did);
      top.append(n.face, texts);
      n.spoken = el("p", "lv-hidden");
      n.spoken.setAttribute("aria-live", "polite");
      grid.append(top, this.$refs.beside);
      now.append(grid, n.spoken);

      const line = section(w.timeline, "lv-wide", "timeline");
      n.strip = el("canvas");
      n.strip.setAttribute("role", "img");
      n.strip.setAttribute("aria-label", w.timeline_label);
      n.list = el("ol", "lv-list");
      n.list.dataset.test = "events";
      n.list.setAttribute("tabindex", "0");
      n.list.setAttribute("aria-label", w.events);
      n.mark = el("p", "lv-dim");
      line.append(n.strip, n.mark, n.list, this.$refs.log);

      const chances = folding(section(w.chances, "", "chances"), true);
      n.bars = el("div");
      n.bars.dataset.test = "bars";
      chances.append(el("p", "lv-dim", w.chances_about), n.bars);

      n.fold = folding(section(w.signals, "", "signals"), innerWidth > NARROW);
      n.signals = el("canvas");
      n.signals.setAttribute("role", "img");
      n.latency = el("p", "lv-dim");
      n.latency.dataset.test = "latency";
      const label = el("label", "lv-check");
      this.enlarge = el("input");
      this.enlarge.type = "checkbox";
      this.enlarge.dataset.test = "enlarge";
      this.enlarge.addEventListener("change", () => { this.range = this.range.map(() => null); this.paint(); });
      label.append(this.enlarge, ` ${w.enlarge}`);
      n.fold.append(label, n.signals, n.latency);
      this.$el.append(root);
    },
    inks() {
      this.fresh = true;
      const css = getComputedStyle(document.body), get = (name) => css.getPropertyValue(name).trim();
      this.ink = { ink: get("--ps-ink"), dim: get("--ps-dim"), line: get("--ps-line"), soft: get("--ps-soft"), dark: document.body.classList.contains("body--dark") };
    },
    size() {
      this.wide = this.$el.clientWidth;
      this.fresh = true;
      const fit = (canvas, height) => {
        const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth;
        canvas.width = Math.max(1, Math.round(width * ratio));
        canvas.height = Math.round(height * ratio);
        canvas.style.height = `${height}px`;
        canvas.getContext("2d").setTransform(ratio, 0, 0, ratio, 0, 0);
        return { width, height };
      };
      this.signalsAt = fit(this.n.signals, Math.max(2, this.channels.length) * this.lane + 24);
      this.stripAt = fit(this.n.strip, STRIP + (this.person ? DID : 0));
    },
    scene(s) {
      if (this.gone) return;
      this.stats.scenes++;
      Object.assign(this, { channels: s.channels, classes: s.classes, windowS: s.window, stripS: s.strip, gateRules: s.gate_rules, layout: s.layout, numbers: s.numbers, person: s.person });
      this.lane = Math.min(140, Math.max(50, Math.round(600 / Math.max(4, s.channels.length))));
      this.xs = [];
      this.ys = this.channels.map(() => []);
      this.range = this.channels.map(() => null);
      this.noise = this.channels.map(() => Infinity);
      this.spans = this.stats.spans = new Map();
      this.did = [];
      this.t = 0;
      this.chances = null;
      this.now = { kind: "stopped", why: "", eyes: "off", sound: "", next: "", warnings: [] };
      this.nowDrawn = this.listed = false;
      this.n.signals.setAttribute("aria-label", fill(this.words.signals_label, { n: this.channels.length, s: s.window }));
      say(this.n.mark, [this.person ? this.words.did_row : "", this.gateRules ? this.words.gate_mark : this.words.gate_none].filter(Boolean).join(" "));
      this.n.mark.hidden = !this.channels.length;
      this.buildBars();
      this.inks();
      this.size();
      this.update(s.first, true);
    },
    buildBars() {
      this.bars = [];
      const groups = ["positive", "neutral", "negative", "none"].map((affect) => [affect, this.classes.map((c, i) => [c, i]).filter(([c]) => c.affect === affect)]);
      this.groups = [];
      this.n.bars.replaceChildren(...groups.filter(([, of]) => of.length).map(([affect, of]) => {
        const group = el("div", "lv-group"), list = el("ul"), head = el("h3");
        head.append(this.badge(el("span", "lv-badge"), affect), " ");
        const sum = head.appendChild(el("span", "lv-dim"));
        this.groups.push({ sum, of: of.map(([, i]) => i), share: -1 });
        for (const [c, i] of of) {
          const row = el("li", "lv-bar"), track = el("i"), bar = el("b"), share = el("span", "", "–");
          row.dataset.label = c.label;
          track.setAttribute("aria-hidden", "true");
          bar.style.background = this.colours[affect];
          track.append(bar);
          row.append(el("span", "", this.name(c.label)), track, share);
          list.append(row);
          this.bars[i] = { row, bar, share, at: -1 };
        }
        group.append(head, list);
        return group;
      }));
    },
    badge(node, affect) {
      const key = affect || "none";
      say(node, `${this.signs[key]} ${this.affects[key]}`);
      node.style.background = this.colours[key];
      node.dataset.affect = key;
      return node;
    },

    // Messages ---------------------------------------------------------------------------------------------------
    update(m, first) {
      if (this.gone) return;
      const clock = performance.timeOrigin + performance.now();
      this.last = m.n;
      if (!first) {
        this.stats.updates++;
        if (this.sameClock) this.delay = clock - m.at;
        else if (m.round !== undefined) this.delay = m.out - m.at + m.round;
        if (this.delay !== undefined && m.at > 0 && m.x && m.x.length) {
          this.stats.delays.push(this.delay);
          if (this.stats.delays.length > KEPT_DELAYS) this.stats.delays.splice(0, 100);
        }
        this.waits = this.waits || m.at;
      }
      this.t = m.t;
      if (m.lat !== undefined) this.decided = m.lat;
      if (m.x && m.x.length) {
        this.stats.samples += m.x.length;
        this.fresh = true;
        this.xs.push(...m.x);
        m.y.forEach((column, i) => this.ys[i].push(...column));
        const from = this.xs[this.xs.length - 1] - this.windowS;
        let cut = 0;
        while (cut < this.xs.length && this.xs[cut] < from) cut++;
        // Cut rarely and many samples at once: it costs as much for one as for fifty.
        if (cut > 50 || this.xs.length > 5000) for (const column of [this.xs, ...this.ys]) column.splice(0, cut);
      }
      if (m.p !== undefined) this.chances = m.p;
      if (m.did) this.did = [...this.did, ...m.did].slice(-100);
      if (m.spans) {
        for (const s of m.spans) {
          this.speakEvent(s, this.spans.get(s.id), first);
          this.spans.set(s.id, s);
        }
        while (this.spans.size > 200) this.spans.delete(this.spans.keys().next().value);
        this.listed = false;
      }
      if (m.now) {
        if (!first && m.now.kind !== this.now.kind && !QUIET.includes(m.now.kind)) this.speak(this.lineOf(m.now));
        this.now = m.now;
        this.nowDrawn = false;
      }
      this.draw();
    },
    draw() {
      if (this.frame || this.gone) return;
      this.frame = requestAnimationFrame(() => {
        this.frame = null;
        if (this.gone) return;
        const began = performance.now();
        this.paint();
        this.stats.drawMs += performance.now() - began;
        this.stats.drawn++;
        if (this.waits && this.sameClock) {
          this.stats.painted.push(performance.timeOrigin + performance.now() - this.waits);
          if (this.stats.painted.length > KEPT_DELAYS) this.stats.painted.splice(0, 100);
        }
        this.waits = 0;
      });
    },
    paint() {
      if (this.n.fold.open && this.fresh) this.drawSignals();
      this.drawStrip();
      this.showNow();
      this.showBars();
      if (!this.listed) this.list();
    },
    tell() {
      if (this.last === undefined || document.hidden) return;
      const sorted = [...this.stats.delays].slice(-200).sort((a, b) => a - b);
      const p95 = sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(0.95 * sorted.length))] : null;
      const w = this.words, parts = [];
      if (this.now.kind !== "stopped") {
        if (this.decided !== undefined) parts.push(fill(w.latency_decision, { ms: this.number(this.decided) }));
        if (p95 !== null && p95 >= 0) parts.push(fill(this.sameClock ? w.latency_page : w.latency_page_most, { ms: this.number(p95) }));
      }
      say(this.n.latency, parts.length ? `${w.latency} ${parts.join("; ")}.` : "");
      this.$emit("seen", { n: this.last, p95, updates: this.stats.updates, drawn: this.stats.drawn });
    },
    number(value) {
      return value.toLocaleString(this.locale, { maximumFractionDigits: value < 10 ? 1 : 0 });
    },

    // Drawing ----------------------------------------------------------------------------------------------------
    drawSignals() {
      this.fresh = false;
      const { width, height } = this.signalsAt, c = this.n.signals.getContext("2d"), k = this.ink;
      c.clearRect(0, 0, width, height);
      const left = Math.min(150, width * 0.3), right = width - 4, lane = this.lane, bottom = this.channels.length * lane;
      // Kept in constants: reading a property of the component costs more than a line of the drawing.
      const xs = this.xs, windowS = this.windowS;
      const end = xs.length ? xs[xs.length - 1] : 0, begin = end - windowS;
      const x = (s) => left + ((s - begin) / windowS) * (right - left);
      c.font = "12px sans-serif";
      c.lineJoin = "bevel";
      c.strokeStyle = k.line;
      c.fillStyle = k.dim;
      c.lineWidth = 1;
      c.textAlign = "center";
      for (let s = Math.ceil(Math.max(begin, 0)); s <= end; s += 1) {
        c.beginPath();
        c.moveTo(x(s), 0);
        c.lineTo(x(s), bottom);
        c.stroke();
        if (s % 2 === 0 && x(s) < right - 12) c.fillText(`${s} s`, x(s), bottom + 16);
      }
      let from = 0;
      while (from < xs.length && xs[from] < begin) from++;
      const across = xs.map(x);
      this.channels.forEach((channel, i) => {
        const ys = this.ys[i], top = i * lane, mid = top + lane / 2;
        let low = Infinity, high = -Infinity;
        for (let j = from; j < ys.length; j++) {
          if (ys[j] < low) low = ys[j];
          if (ys[j] > high) high = ys[j];
        }
        c.textAlign = "left";
        c.fillStyle = k.ink;
        c.fillText(this.names[channel.name] || channel.name, 0, mid - 3);
        if (low > high) return;
        const value = (ys[ys.length - 1] * channel.step - channel.offset) * channel.scale;
        c.fillStyle = k.dim;
        c.fillText(`${this.digits.format(value)} ${channel.unit === "count" ? this.words.unit_count : channel.unit}`, 0, mid + 13);
        // A lane has the range of the session so far, and many times the noise: at rest it is flat. Enlarged, it keeps its
        // scale until the signal leaves it or has long been small in it.
        let kept = this.range[i], span = Math.max(high - low, 8), moved = 0;
        if (!this.enlarge.checked) {
          for (let j = from + 1; j < ys.length; j++) moved += Math.abs(ys[j] - ys[j - 1]);
          if (ys.length - from > 50) this.noise[i] = Math.min(this.noise[i], moved / (ys.length - from));
          const middle = (low + high) / 2, least = Number.isFinite(this.noise[i]) ? 20 * this.noise[i] : 0;
          low = Math.min(low, middle - least);
          high = Math.max(high, middle + least);
          if (kept && (low < kept[0] || high > kept[1])) kept = [Math.min(low, kept[0]), Math.max(high, kept[1])];
          this.range[i] = kept ?? [low, high];
        } else if (!kept || low < kept[0] || high > kept[1] || kept[1] - kept[0] > 3 * span) {
          this.range[i] = [low - 0.15 * span, high + 0.15 * span];
        }
        const [a, b] = this.range[i], y = (v) => top + 3 + (1 - (v - a) / (b - a)) * (lane - 6);
        c.strokeStyle = k.line;
        c.beginPath();
        c.moveTo(0, top + lane);
        c.lineTo(right, top + lane);
        c.stroke();
        c.strokeStyle = k.dark ? "#8cc4f0" : this.lines[0];
        c.lineWidth = 1;
        c.beginPath();
        for (let j = from; j < ys.length; j++) {
          // A gap in the clock of the toy is a gap in the line.
          if (j === from || xs[j] - xs[j - 1] > 0.3) c.moveTo(across[j], y(ys[j]));
          else c.lineTo(across[j], y(ys[j]));
        }
        c.stroke();
        c.lineWidth = 1;
      });
    },
    drawStrip() {
      const { width, height } = this.stripAt, c = this.n.strip.getContext("2d"), k = this.ink, shift = height - STRIP;
      c.clearRect(0, 0, width, height);
      const stripS = this.stripS, begin = this.t - stripS, x = (s) => ((s - begin) / stripS) * width;
      c.font = "12px sans-serif";
      c.textAlign = "center";
      for (let s = Math.ceil(Math.max(0, begin) / 10) * 10; s <= this.t; s += 10) {
        c.strokeStyle = k.line;
        c.beginPath();
        c.moveTo(x(s), 0);
        c.lineTo(x(s), height - 22);
        c.stroke();
        c.fillStyle = k.dim;
        if (x(s) > 14 && x(s) < width - 14) c.fillText(`${s} s`, x(s), height - 6);
      }
      c.textAlign = "left";
      const ends = [-1, -1];
      let last = -1;
      for (const d of this.did) {
        if (d.to < begin) continue;
        const a = Math.max(x(d.from), 0), b = Math.max(x(Math.min(d.to, this.t)), a + 3), label = this.name(d.label);
        c.fillStyle = k.dim;
        c.fillRect(a, 4, b - a, 5);
        const wide = c.measureText(label).width, at = Math.min(a, width - wide);
        if (at > last) {
          c.fillText(label, at, 22);
          last = at + wide + 6;
        }
      }
      for (const s of this.spans.values()) {
        const to = s.to === null ? this.t : s.to;
        if (to < begin) continue;
        const row = s.id % 2, top = shift + 4 + row * 36, a = Math.max(x(s.from), 0), b = Math.max(x(to), a + 3);
        c.fillStyle = this.colours[s.affect || "none"];
        c.fillRect(a, top, b - a, 12);
        if (s.source === "gate") {
          c.fillStyle = k.ink;
          c.beginPath();
          c.moveTo(a, top - 3);
          c.lineTo(a + 8, top + 6);
          c.lineTo(a, top + 15);
          c.fill();
        }
        c.fillStyle = k.ink;
        const label = `${this.signs[s.affect || "none"]} ${this.nameOf(s)}`;
        const wide = c.measureText(label).width, at = Math.min(a, width - wide);
        // Skip names that would overlap; the list has them all.
        if (at > ends[row]) {
          c.fillText(label, at, top + 27);
          ends[row] = at + wide + 6;
        }
      }
    },
    showNow() {
      const w = this.words, now = this.now;
      if (this.person) {
        // A gesture begins and ends by the clock of the toy, without a message.
        const made = this.did.findLast((d) => d.from <= this.t && this.t <= d.to);
        const doing = made ? this.name(made.label) : now.next ? fill(w.really_next, { gesture: this.name(now.next) }) : w.really_nothing;
        say(this.n.did, `${w.really} ${now.kind === "stopped" ? "–" : doing}`);
        this.n.did.dataset.label = made ? made.label : "";
      }
      if (this.nowDrawn) return;
      this.nowDrawn = true;
      this.n.did.hidden = !this.person;
      const event = now.kind === "event";
      say(this.n.state, this.lineOf(now));
      Object.assign(this.n.state.dataset, { kind: now.kind, label: (event && now.gesture) || "" });
      this.n.badge.hidden = this.n.sure.hidden = !event;
      if (event) this.badge(this.n.badge, now.affect);
      say(this.n.sure, event && now.confidence !== null ? `${now.confidence} %` : "");
      const about = event ? w[now.source === "gate" ? "by_gate" : "by_network"] : fill(w[`about_${now.kind}`] || "", { layout: this.layout, n: this.numbers });
      say(this.n.about, now.why || about);
      say(this.n.warnings, (now.warnings || []).join(" "));
      this.n.warnings.hidden = !(now.warnings || []).length;
      const eyes = EYES[now.eyes] ? now.eyes : "off", parts = [w[`eyes_${eyes}`]];
      if (now.sound) parts.push(`♪ ${w[`sound_${now.sound}`] || now.sound}`);
      if (now.quiet) parts.push(w[`quiet_${now.quiet}`]);
      else if (!event && now.reacts_to) parts.push(fill(w.reacts_to, { what: this.affects[now.reacts_to] || this.name(now.reacts_to) }));
      const text = parts.join(" · ");
      if (this.n.face.dataset.eyes !== eyes) {
        this.n.face.dataset.eyes = eyes;
        this.n.face.innerHTML = face(eyes);
      }
      this.n.face.setAttribute("aria-label", `${w.eyes_label}: ${text}`);
      say(this.n.eyes, text);
    },
    showBars() {
      const p = this.chances, best = p ? p.indexOf(Math.max(...p)) : -1;
      this.bars.forEach((bar, i) => {
        const at = p ? p[i] : -1;
        if (at !== bar.at) {
          bar.at = at;
          bar.bar.style.transform = `scaleX(${Math.max(0, at) / 1000})`;
          say(bar.share, at < 0 ? "–" : `${Math.round(at / 10)} %`);
        }
        bar.row.classList.toggle("lv-best", i === best);
      });
      for (const group of this.groups) {
        const share = p ? Math.round(group.of.reduce((sum, i) => sum + p[i], 0) / 10) : -1;
        if (share !== group.share) say(group.sum, (group.share = share) < 0 ? "" : `${Math.min(100, share)} %`);
      }
    },
    list() {
      this.listed = true;
      const w = this.words, spans = [...this.spans.values()].slice(-20).reverse();
      if (!spans.length) return this.n.list.replaceChildren(el("li", "lv-dim", w.events_none));
      this.n.list.replaceChildren(...spans.map((s) => {
        const row = el("li");
        Object.assign(row.dataset, { id: s.id, affect: s.affect, gesture: s.gesture || "", from: s.from, to: s.to === null ? "" : s.to, source: s.source });
        const seconds = (v) => v.toLocaleString(this.locale, { minimumFractionDigits: 1, maximumFractionDigits: 1 });
        row.append(el("span", "", `${seconds(s.from)} s`), this.badge(el("span", "lv-badge"), s.affect), el("b", "", this.nameOf(s)),
          el("span", "", s.sure === null ? "" : `${s.sure} %`), el("span", "", s.to === null ? w.lasting : `${seconds(s.to - s.from)} s`),
          el("span", "lv-dim", [s.source === "gate" ? w.by_gate : w.by_network, this.reactionOf(s)].filter(Boolean).join(" · ")));
        return row;
      }));
    },

    // Texts -----------------------------------------------------------------------------------------------
    name(label) { return this.gestures[label] || label; },
    nameOf(s) { return s.gesture ? this.name(s.gesture) : this.words.some_gesture; },
    lineOf(now) { return now.kind === "event" ? this.nameOf(now) : this.words[`state_${now.kind}`]; },
    reactionOf(s) {
      if (!s.eyes) return "";
      return [this.words[`eyes_${s.eyes}`], s.sound && (this.words[`sound_${s.sound}`] || s.sound)].filter(Boolean).join(", ");
    },
    speakEvent(s, before, first) {
      if (first || s.to !== null || (before && before.gesture === s.gesture)) return;
      this.speak(`${this.nameOf(s)}, ${this.affects[s.affect || "none"]}`);
    },
    speak(text) {
      // Announce at most one sentence at a time, always the newest, so that the speech does not lag behind the toy.
      this.speaks = text;
      if (this.speaking) return;
      const due = () => {
        this.speaking = null;
        if (this.speaks === null || this.gone) return;
        say(this.n.spoken, this.speaks);
        this.speaks = null;
        this.speaking = setTimeout(due, SPOKEN_MS);
      };
      due();
    },
  },
};
