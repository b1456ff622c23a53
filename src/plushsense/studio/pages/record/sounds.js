// Sounds of the countdown and the recording, and the mark for a video: a white flash and a tone at one moment.
const STORED = "plushsense_sound";

export default {
  template: `<span class="ps-sounds">
    <button type="button" class="ps-plain-button" data-test="sound" :aria-pressed="on ? 'true' : 'false'" @click="toggle">
      {{ on ? texts.on : texts.off }}</button>
    <button type="button" class="ps-plain-button" data-test="mark" @click="mark(false)">{{ texts.mark }}</button>
    </span>`,
  props: { texts: Object, beat: String, mark_first: Boolean },
  data() {
    return { on: localStorage.getItem(STORED) !== "off" };
  },
  watch: {
    beat(now, before) {
      const [state, number] = now.split(".");
      const was = before.split(".")[0];
      if (state === "countdown" && this.mark_first && !this.marked) this.mark(true);
      if (state === "countdown" && number !== "0") this.tone(660, 0.06);
      if (state === "recording" && was !== "recording") this.tone(990, 0.3);
      if (was === "recording" && state !== "recording") this.tone(440, 0.3);
    },
  },
  beforeUnmount() {
    this.audio?.close();
  },
  methods: {
    toggle() {
      this.on = !this.on;
      localStorage.setItem(STORED, this.on ? "on" : "off");
      if (this.on) this.tone(660, 0.06);
    },
    tone(hertz, seconds) {
      // Browsers play sounds only after the first press on a page.
      if (!this.on || navigator.userActivation?.hasBeenActive === false) return;
      this.audio ??= new AudioContext();
      if (this.audio.state === "suspended") this.audio.resume();
      const { audio } = this, now = audio.currentTime;
      const oscillator = audio.createOscillator(), gain = audio.createGain();
      oscillator.frequency.value = hertz;
      gain.gain.setValueAtTime(0.2, now);
      gain.gain.exponentialRampToValueAtTime(0.001, now + seconds);
      oscillator.connect(gain).connect(audio.destination);
      oscillator.start(now);
      oscillator.stop(now + seconds);
    },
    mark(first) {
      this.marked = true;
      const flash = document.createElement("div");
      flash.className = "ps-flash";
      document.body.append(flash);
      this.tone(1320, 0.2);
      this.$emit("mark", { first });
      setTimeout(() => flash.remove(), 300);
    },
  },
};
