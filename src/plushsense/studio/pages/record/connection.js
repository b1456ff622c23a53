// Asks the studio once a second for an answer, and displays a message while there is none.
const ASK_MS = 1000, SILENT_MS = 5000;

export default {
  template: '<div role="alert" class="ps-connection-lost"><span v-if="lost">{{ text }}</span></div>',
  props: { text: String },
  data() {
    return { lost: false };
  },
  mounted() {
    this.asked = this.answered = performance.now();
    this.timer = setInterval(() => this.look(), ASK_MS / 4);
  },
  beforeUnmount() {
    clearInterval(this.timer);
    document.body.classList.remove("ps-disconnected");
  },
  methods: {
    look() {
      // The socket is created after the elements of the page.
      if (!window.did_handshake) return;
      const now = performance.now(), connected = window.socket.connected;
      // A computer that slept, or a tab in the background, did not ask in the meantime.
      if (now - this.asked > 2 * ASK_MS) this.answered = Math.max(this.answered, now - SILENT_MS / 2);
      if (connected && now - this.asked >= ASK_MS) {
        this.asked = now;
        this.$emit("ask");
      }
      if (!connected || now - this.answered > SILENT_MS) this.set(true);
    },
    answer() {
      this.answered = performance.now();
      this.set(false);
    },
    set(lost) {
      this.lost = lost;
      document.body.classList.toggle("ps-disconnected", lost);
    },
  },
};
