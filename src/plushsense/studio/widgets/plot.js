// uPlot as a Vue component: `show` sets fixed data, and `push` appends live samples.
import { loadResource } from "../../static/utils/resources.js";

const colour = (name) => getComputedStyle(document.body).getPropertyValue(name).trim() || "#555";

export default {
  template: '<div role="img" :aria-label="label"><div ref="place"></div></div>',
  props: {
    label: String, series: Array, xTitle: String, yTitle: String, height: Number, windowS: Number,
    start: Array, share: Boolean, resourcePath: String,
  },
  async mounted() {
    await this.$nextTick();
    const at = window.path_prefix + this.resourcePath;
    await Promise.all([loadResource(`${at}/uPlot.min.css`), loadResource(`${at}/uPlot.iife.min.js`)]);
    this.curves = this.series;
    this.kept = this.start || [[], ...this.series.map(() => [])];
    this.build();
    this.resizer = new ResizeObserver(() => {
      const width = this.$el.clientWidth;
      if (this.u && width && width !== this.u.width) this.u.setSize({ width, height: this.height });
    });
    this.resizer.observe(this.$el);
    this.dark = document.body.classList.contains("body--dark");
    this.lights = new MutationObserver(() => {
      // Other classes of the body change with every key.
      const dark = document.body.classList.contains("body--dark");
      if (dark !== this.dark) {
        this.dark = dark;
        this.build();
      }
    });
    this.lights.observe(document.body, { attributes: true, attributeFilter: ["class"] });
    for (const late of this.late || []) late();
    this.late = null;
  },
  beforeUnmount() {
    this.resizer?.disconnect();
    this.lights?.disconnect();
    this.u?.destroy();
    this.u = null;
  },
  methods: {
    build() {
      const off = this.u ? this.u.series.map((s) => s.show) : null;
      this.u?.destroy();
      const ink = colour("--ps-ink"), grid = { stroke: colour("--ps-line"), width: 1 };
      const number = new Intl.NumberFormat(document.documentElement.lang || "en", { maximumFractionDigits: 4 });
      const values = (u, splits) => splits.map((v) => (v == null ? "" : number.format(v)));
      const axis = (title, size) => ({ values, stroke: ink, grid, ticks: grid, label: title || undefined, labelSize: 22, size });
      const options = {
        width: this.$el.clientWidth || 600,
        height: this.height,
        legend: { live: false },
        cursor: { drag: { x: false, y: false } },
        scales: { x: { time: false }, ...(this.share ? { y: { range: [0, 1] } } : {}) },
        axes: [axis(this.xTitle, 44), axis(this.yTitle, 64)],
        series: [{ label: this.xTitle || "x" },
          ...this.curves.map((s, i) => ({ width: 1.5, points: { show: false }, ...s,
            points: { show: s.points === true }, ...(off && off[i + 1] === false ? { show: false } : {}) }))],
      };
      this.u = new uPlot(options, this.kept, this.$refs.place);
    },
    ready(call) {
      // A method may be called before the library is loaded.
      if (this.u) return true;
      (this.late = this.late || []).push(call);
      return false;
    },
    show(data, series) {
      if (!this.ready(() => this.show(data, series))) return;
      this.kept = data;
      if (series) {
        this.curves = series;
        this.build();
      } else {
        this.u.setData(data);
      }
    },
    push(x, curves) {
      if (!this.ready(() => this.push(x, curves))) return;
      const all = [x, ...curves];
      for (let i = 0; i < all.length; i++) for (const v of all[i]) this.kept[i].push(v);
      const xs = this.kept[0], from = xs[xs.length - 1] - this.windowS;
      if (this.windowS > 0) {
        let cut = 0;
        while (cut < xs.length && xs[cut] < from) cut++;
        if (cut > 0) for (const column of this.kept) column.splice(0, cut);
      }
      this.pushed = (this.pushed || 0) + 1;
      this.u.setData(this.kept, false);
      const low = this.windowS > 0 ? from : xs[0];
      this.u.batch(() => {
        this.u.setScale("x", { min: low, max: xs[xs.length - 1] });
        this.scaleY();
      });
    },
    scaleY() {
      let low = Infinity, high = -Infinity;
      for (let i = 1; i < this.kept.length; i++) {
        if (this.u.series[i].show === false) continue;
        for (const v of this.kept[i]) {
          if (v < low) low = v;
          if (v > high) high = v;
        }
      }
      if (low > high) return;
      const pad = 0.05 * (high - low || 1);
      this.u.setScale("y", { min: low - pad, max: high + pad });
    },
  },
};
