// Area that uploads files and folders: chosen in the browser's dialog, or dropped anywhere onto the page.
const BATCH_BYTES = 32e6;
const BATCH_FILES = 200;

export default {
  template: `
    <div class="ps-drop w-full" :class="{'ps-drop-over': over}">
      <slot></slot>
      <input ref="files" type="file" multiple hidden :accept="accept" @change="choose">
      <input ref="folder" type="file" webkitdirectory hidden @change="choose">
      <div v-if="sending" class="row items-center no-wrap ps-small-gap w-full" data-test="uploading">
        <q-linear-progress class="col" rounded size="12px" :value="share" :aria-label="texts.sending" />
        <span role="status">{{ texts.sending }} {{ Math.floor(share * 100) }} %</span>
        <q-btn flat no-caps :label="texts.cancel" @click="cancel" />
      </div>
    </div>`,
  props: { url: String, accept: String, limit: Number, texts: Object },
  data: () => ({ over: false, sending: false, share: 0 }),
  mounted() {
    this.listeners = {
      dragover: (event) => this.drag(event, true),
      dragleave: (event) => this.drag(event, event.relatedTarget !== null),
      drop: (event) => this.drop(event),
    };
    for (const [type, listener] of Object.entries(this.listeners)) document.addEventListener(type, listener);
  },
  beforeUnmount() {
    for (const [type, listener] of Object.entries(this.listeners)) document.removeEventListener(type, listener);
    this.cancel();
  },
  methods: {
    pick(folder) {
      this.$refs[folder ? "folder" : "files"].click();
    },
    choose(event) {
      const files = [...event.target.files].map((file) => ({ file, path: file.webkitRelativePath || file.name }));
      event.target.value = "";
      this.send(files);
    },
    drag(event, over) {
      if (!event.dataTransfer || ![...event.dataTransfer.types].includes("Files")) return;
      event.preventDefault();
      this.over = over;
    },
    async drop(event) {
      this.drag(event, false);
      // The entries must be taken before the first wait: the browser clears the list afterwards.
      const items = event.dataTransfer ? [...event.dataTransfer.items] : [];
      const entries = items.map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
      this.send((await Promise.all(entries.map((entry) => this.walk(entry)))).flat());
    },
    async walk(entry) {
      if (entry.isFile) {
        const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
        return [{ file, path: entry.fullPath.replace(/^\//, "") }];
      }
      const reader = entry.createReader();
      const found = [];
      // A reader returns the entries of a folder in parts.
      for (;;) {
        const part = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
        if (!part.length) break;
        found.push(...part);
      }
      return (await Promise.all(found.map((each) => this.walk(each)))).flat();
    },
    async send(files) {
      if (this.sending || !files.length) return;
      const large = files.filter(({ file }) => file.size > this.limit).map(({ path }) => path);
      const rest = files.filter(({ file }) => file.size <= this.limit);
      const total = rest.reduce((sum, { file }) => sum + file.size, 0) || 1;
      let done = 0;
      let ok = true;
      this.sending = true;
      this.share = 0;
      while (rest.length && ok && this.sending) {
        const batch = [rest.shift()];
        let bytes = batch[0].file.size;
        while (rest.length && batch.length < BATCH_FILES && bytes + rest[0].file.size <= BATCH_BYTES) {
          bytes += rest[0].file.size;
          batch.push(rest.shift());
        }
        ok = await this.post(batch, (sent) => (this.share = (done + Math.min(sent, bytes)) / total));
        done += bytes;
      }
      const cancelled = !this.sending;
      this.sending = false;
      this.$emit("finish", { ok, cancelled, large });
    },
    post(batch, report) {
      const form = new FormData();
      // Encoded, since the server drops the folders of a file name.
      batch.forEach(({ file, path }, number) => form.append(`file${number}`, file, encodeURIComponent(path)));
      return new Promise((resolve) => {
        const request = (this.request = new XMLHttpRequest());
        request.upload.onprogress = (event) => report(event.loaded);
        request.onload = () => resolve(request.status === 200);
        request.onerror = request.onabort = () => resolve(false);
        request.open("POST", (window.path_prefix || "") + this.url);
        request.send(form);
      });
    },
    cancel() {
      this.sending = false;
      this.request?.abort();
    },
  },
};
