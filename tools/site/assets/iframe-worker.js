// Browsers start no worker for a page that is opened from a folder (file://). The search of the site then runs in a
// hidden frame instead. The file name keeps the theme from loading such a script from another host.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.onmessage = null;
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.documentElement.appendChild(this.frame);
      const inner = this.frame.contentWindow;
      inner.answer = (data) => {
        const event = new MessageEvent("message", { data });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      this.loaded = new Promise((resolve) => (inner.markLoaded = resolve));
      inner.document.open();
      inner.document.write(
        "<script>postMessage = (data) => answer(data); importScripts = () => {};</script>" +
          `<script src="${url}" onload="markLoaded()"></script>`,
      );
      inner.document.close();
    }

    postMessage(data) {
      this.loaded.then(() => {
        const inner = this.frame.contentWindow;
        inner.dispatchEvent(new inner.MessageEvent("message", { data }));
      });
    }

    terminate() {
      this.frame.remove();
    }
  };
}
