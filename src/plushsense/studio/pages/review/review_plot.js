// The plot of the review page: curves, marks, clicks and keys. Each key is sent with the recording that was displayed when
// it was pressed, so that it never applies to another one.
import { loadResource } from "../../static/utils/resources.js";

const colour = (name) => getComputedStyle(document.body).getPropertyValue(name).trim() || "#555";
// Dark colours of curves are hard to see on a dark page: raise the lightness of "#rrggbb" or "#rrggbbaa".
function lighten(stroke) {
  const match = /^#([0-9a-f]{2})([0-9a-f]{2})([0-9a-f]{2})([0-9a-f]{2})?$/i.exec(stroke || "");
  if (!match) return stroke;
  const rgb = match.slice(1, 4).map((part) => parseInt(part, 16));
  const light = (0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]) / 255, least = 0.62;
  const mix = light < least ? (least - light) / (1 - light) : 0;
  const hex = rgb.map((v) => Math.round(v + (255 - v) * mix).toString(16).padStart(2, "0")).join("");
  return `#${hex}${match[4] || ""}`;
}
const OURS = ["Enter", "Backspace", "ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Home", "End", "Escape"];
const LETTERS = ["x", "g", "u", "s", "i", "p", "h", "r", "d", "+", "-", "0", ",", ".", ";", ":", "<", ">"];
const REPEATED = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", ",", ".", "<", ">", ";", ":"];

export default {
  template: '<div role="img" :aria-label="text" tabindex="-1" :data-recording="recording"><div ref="place"></div></div>',
  props: { label: String, height: Number, legend: Boolean, keyed: Boolean, selects: Boolean, resourcePath: String },
  data() {
    return { text: this.label, recording: "" };
  },
  async mounted() {
    await this.$nextTick();
    const at = window.path_prefix + this.resourcePath;
    await Promise.all([loadResource(`${at}/uPlot.min.css`), loadResource(`${at}/uPlot.iife.min.js`)]);
    this.$el.psPlot = this;
    this.marks = [];
    this.times = [];
    this.resizer = new ResizeObserver(() => {
      const width = this.$el.clientWidth;
      if (this.u && width && width !== this.u.width) this.u.setSize({ width, height: this.pixels() });
    });
    this.resizer.observe(this.$el);
    // Other classes of the body change with every key.
    this.lights = new MutationObserver(() => {
      if (this.p && this.dark !== document.body.classList.contains("body--dark")) this.build();
    });
    this.lights.observe(document.body, { attributes: true, attributeFilter: ["class"] });
    this.onKey = (event) => this.key(event);
    this.onClick = (event) => {
      // After a mouse click, the focus returns to the plot; after a click by keyboard it stays on the button.
      if (event.detail > 0 && event.target.closest("button.ps-act")) this.$el.focus({ preventScroll: true });
    };
    if (this.keyed) {
      document.addEventListener("keydown", this.onKey);
      document.addEventListener("click", this.onClick);
    }
    this.loaded = true;
    for (const late of this.late || []) late();
    this.late = null;
  },
  beforeUnmount() {
    document.removeEventListener("keydown", this.onKey);
    document.removeEventListener("click", this.onClick);
    this.resizer?.disconnect();
    this.lights?.disconnect();
    this.u?.destroy();
    this.u = null;
  },
  methods: {
    key(event) {
      const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
      if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
      if (!OURS.includes(key) && !LETTERS.includes(key)) return;
      const on = event.target instanceof Element ? event.target : document.body;
      if (!this.$el.offsetParent || document.querySelector(".q-dialog__inner, .q-menu")) return;
      if (on.closest("input, textarea, select, [contenteditable=true], [role=combobox], [role=listbox], [role=slider]")) return;
      // A focused control handles its own keys.
      if (key === "Enter" && on.closest("button, a, summary, [role=button], [role=switch], [tabindex='0']")) return;
      if (key.startsWith("Arrow") && on.closest("[role=tab], [role=radio], [role=radiogroup]")) return;
      event.preventDefault();
      if (event.repeat && !REPEATED.includes(key)) return;
      if (key === "+" || key === "-" || key === "0") return this.zoom(key === "+" ? 0.5 : key === "-" ? 2 : 0);
      this.pressed = performance.now();
      this.$emit("key", { key, shift: event.shiftKey, recording: this.recording });
    },
    pixels() {
      return this.height > 1 ? this.height : Math.max(240, Math.round(window.innerHeight * this.height));
    },
    build() {
      this.u?.destroy();
      this.dark = document.body.classList.contains("body--dark");
      const p = this.p, ink = colour("--ps-ink"), grid = { stroke: colour("--ps-line"), width: 1 };
      const number = new Intl.NumberFormat(document.documentElement.lang || "en", { maximumFractionDigits: 4 });
      const values = (u, splits) => splits.map((v) => (v == null ? "" : number.format(v)));
      // Dots are numbered, so only whole numbers are labelled.
      const counts = p.series.some((s) => s.dots) ? { incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 10000] } : {};
      const y = { values, stroke: ink, grid, ticks: grid, label: p.y_title || undefined, labelSize: 22, size: 64 };
      if (p.lanes.length > 1) {
        y.splits = () => p.lanes.map((lane) => lane[0]);
        y.values = () => p.lanes.map((lane) => lane[1]);
        y.size = 96;
        y.grid = { show: false };
        y.ticks = { show: false };
      }
      const options = {
        width: this.$el.clientWidth || 600,
        height: this.pixels(),
        bands: p.bands || [],
        legend: { show: this.legend, live: false, markers: { fill: (u, i) => u.series[i].stroke(u, i) } },
        cursor: { drag: { x: this.selects, y: false, setScale: false, dist: 4 }, points: { show: false } },
        scales: { x: { time: false }, y: p.limits ? { range: p.limits } : {} },
        axes: [{ ...counts, values, stroke: ink, grid, ticks: grid, label: p.x_title, labelSize: 22, size: 44 }, y],
        series: [{ label: p.x_title }, ...p.series.map((s) => this.style(s))],
        hooks: { drawClear: [(u) => this.drawBehind(u)], draw: [(u) => this.drawMarks(u)], setSelect: [(u) => this.select(u)] },
      };
      this.u = new uPlot(options, p.data, this.$refs.place);
      const over = this.u.over;
      over.style.cursor = "crosshair";
      const pick = (event, button) => {
        event.preventDefault();
        if (performance.now() - (this.selected || -1000) < 100) return;
        const box = over.getBoundingClientRect();
        const x = this.u.posToVal(event.clientX - box.left, "x"), v = this.u.posToVal(event.clientY - box.top, "y");
        this.$emit("pick", { x, y: v, button, shift: event.shiftKey, recording: this.recording });
      };
      over.addEventListener("click", (event) => pick(event, "left"));
      over.addEventListener("contextmenu", (event) => pick(event, "right"));
      over.addEventListener("wheel", (event) => {
        if (!event.ctrlKey) return;
        event.preventDefault();
        const x = this.u.posToVal(event.clientX - over.getBoundingClientRect().left, "x");
        this.zoom(event.deltaY < 0 ? 0.7 : 1.4, x);
      }, { passive: false });
    },
    style(s) {
      const stroke = this.dark ? lighten(s.stroke) : s.stroke;
      if (!s.dots) return { width: 1.4, points: { show: false }, ...s, stroke };
      return { ...s, stroke, paths: () => null, points: { show: true, size: 8, fill: stroke, stroke } };
    },
    select(u) {
      const { left, width } = u.select;
      if (width < 1) return;
      // The click that ends the drag is no click into the plot.
      this.selected = performance.now();
      this.$emit("selected", { low: u.posToVal(left, "x"), high: u.posToVal(left + width, "x"), recording: this.recording });
      u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    },
    drawBehind(u) {
      // Shade ranges with their names, if these fit in, and the part of the stream before the recording.
      const { ctx } = u, { left, top, width, height } = u.bbox, x = (v) => u.valToPos(v, "x", true);
      const fill = (from, to, style, name) => {
        const a = Math.max(left, from), b = Math.min(left + width, to);
        if (b <= a) return;
        ctx.fillStyle = style;
        ctx.fillRect(a, top, b - a, height);
        if (!name) return;
        ctx.font = `${12 * devicePixelRatio}px sans-serif`;
        if (ctx.measureText(name).width > b - a - 4) return;
        ctx.fillStyle = colour("--ps-ink");
        ctx.textAlign = "left";
        ctx.textBaseline = "alphabetic";
        ctx.fillText(name, a + 2, top + height - 6 * devicePixelRatio);
      };
      ctx.save();
      if (this.p.data[0][0] < 0) fill(x(this.p.data[0][0]), x(0), "rgba(128,128,128,0.28)");
      for (const [from, to, style, name] of this.cut || []) fill(x(from), x(to), style || "rgba(213,94,0,0.16)", name);
      ctx.restore();
    },
    drawMarks(u) {
      const { ctx } = u, { left, top, width, height } = u.bbox;
      ctx.save();
      ctx.beginPath();
      ctx.rect(left, top, width, height);
      ctx.clip();
      ctx.textBaseline = "alphabetic";
      this.marks.forEach((m, i) => {
        const x = u.valToPos(m.x, "x", true);
        ctx.strokeStyle = ctx.fillStyle = colour(m.stroke || "--ps-ink");
        ctx.lineWidth = 2 * devicePixelRatio;
        ctx.setLineDash((m.dash || []).map((v) => v * devicePixelRatio));
        ctx.beginPath();
        ctx.moveTo(x, top);
        ctx.lineTo(x, top + height);
        ctx.stroke();
        if (!m.label) return;
        ctx.font = `${13 * devicePixelRatio}px sans-serif`;
        ctx.textAlign = "left";
        const wide = ctx.measureText(m.label).width, pad = 4 * devicePixelRatio;
        const at = x + pad + wide > left + width ? x - pad - wide : x + pad, line = top + (14 + 16 * (i % 2)) * devicePixelRatio;
        const ground = getComputedStyle(document.body).backgroundColor;
        ctx.save();
        ctx.fillStyle = ground === "rgba(0, 0, 0, 0)" ? "#fff" : ground;
        ctx.globalAlpha = 0.8;
        ctx.fillRect(at - 2, line - 12 * devicePixelRatio, wide + 4, 15 * devicePixelRatio);
        ctx.restore();
        ctx.fillText(m.label, at, line);
      });
      ctx.restore();
      if (this.pressed && this.drawn !== this.recording) {
        const since = this.pressed;
        this.pressed = 0;
        this.drawn = this.recording;
        requestAnimationFrame(() => this.times.push(performance.now() - since));
      }
    },
    ready(call) {
      if (this.loaded) return true;
      (this.late = this.late || []).push(call);
      return false;
    },
    show(p) {
      if (!this.ready(() => this.show(p))) return;
      const same = this.u && JSON.stringify([p.series, p.lanes, p.y_title, p.limits]) === this.kind;
      const kept = this.u && p.id === this.recording && p.keep ? { ...this.u.scales.x } : null;
      this.p = p;
      this.text = p.label;
      this.marks = p.marks;
      this.cut = p.cut;
      this.recording = p.id;
      if (same) this.u.setData(p.data, !kept);
      else this.build();
      this.kind = JSON.stringify([p.series, p.lanes, p.y_title, p.limits]);
      if (kept) this.u.setScale("x", { min: kept.min, max: kept.max });
    },
    remark(id, marks, cut, label) {
      if (!this.ready(() => this.remark(id, marks, cut, label)) || id !== this.recording) return;
      this.marks = marks;
      this.cut = cut;
      this.text = label;
      this.u?.redraw(false);
    },
    look(low, high) {
      const xs = this.p?.data[0];
      if (!this.u || high - low < 0.02) return;
      const first = xs[0], last = xs[xs.length - 1], width = Math.min(high - low, last - first);
      const from = Math.min(Math.max(first, low), last - width);
      this.u.setScale("x", { min: from, max: from + width });
      if (this.p.thinned) this.$emit("zoomed", { low: from, high: from + width, recording: this.recording });
    },
    pan(share) {
      if (!this.u) return;
      const { min, max } = this.u.scales.x;
      this.look(min + share * (max - min), max + share * (max - min));
    },
    zoom(factor, at) {
      if (!this.u) return;
      const xs = this.p.data[0], first = xs[0], last = xs[xs.length - 1], { min, max } = this.u.scales.x;
      let low = first, high = last;
      if (factor > 0) {
        const seen = this.marks.find((m) => m.x >= min && m.x <= max);
        const centre = at ?? (seen ? seen.x : (min + max) / 2);
        low = Math.max(first, centre - (centre - min) * factor);
        high = Math.min(last, centre + (max - centre) * factor);
      }
      if (high - low < 0.02) return;
      this.u.setScale("x", { min: low, max: high });
      if (this.p.thinned) this.$emit("zoomed", { low, high, recording: this.recording });
    },
  },
};
