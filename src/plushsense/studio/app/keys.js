// Keyboard commands of a page: each press is emitted once, as `press`, with what the page showed at that moment.
const CONTROLS = "button, a[href], summary, [role=button]";

export default {
  template: '<span hidden :data-seen="seen"></span>',
  props: { seen: String, keys: String, fields: Object, aliases: Object },
  mounted() {
    this.listener = (event) => this.onKey(event);
    // In the capture phase: a space must not also press the button that has the focus.
    for (const type of ["keydown", "keypress", "keyup"]) window.addEventListener(type, this.listener, true);
    // After a click by mouse or finger the control gives up the focus, so that the next space is a command.
    this.release = (event) => event.detail > 0 && document.activeElement?.closest(CONTROLS) && document.activeElement.blur();
    window.addEventListener("click", this.release);
  },
  beforeUnmount() {
    window.removeEventListener("click", this.release);
    for (const type of ["keydown", "keypress", "keyup"]) window.removeEventListener(type, this.listener, true);
  },
  methods: {
    onKey(event) {
      if (event.ctrlKey || event.altKey || event.metaKey || event.isComposing) return;
      const at = event.target;
      if (at && at.matches && (at.isContentEditable || at.matches("input, textarea, select"))) return;
      if (event.key === "Enter" && event.repeat) {
        // A held Enter presses a button once.
        event.preventDefault();
        event.stopImmediatePropagation();
        return;
      }
      const typed = event.code === "Space" ? " " : event.key.toLowerCase();
      // The space bar and Enter press the control that has the focus.
      if ((typed === " " || typed === "enter") && at.closest && at.closest(CONTROLS)) return;
      const key = this.aliases[typed] ?? typed;
      if (this.fields[key]) {
        event.preventDefault();
        event.stopImmediatePropagation();
        // Immediately and in the browser: the next letter may already be on its way.
        if (event.type === "keydown") document.querySelector(this.fields[key])?.focus();
        return;
      }
      if (key.length !== 1 || !this.keys.includes(key)) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      if (event.type !== "keydown" || event.repeat) return;
      // Without a connection a press is dropped: sent later, it could mean something else.
      if (!window.socket || !window.socket.connected || document.body.classList.contains("ps-disconnected")) return;
      this.$emit("press", { key, seen: this.seen });
    },
  },
};
