// Browsers start no workers from files. Search needs one: where the site is opened from a folder, a hidden frame does it.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      this.frame = frame;
      const inside = frame.contentDocument;
      inside.open();
      inside.write(
        "<script>postMessage = data => parent.dispatchEvent(" +
          "new MessageEvent('message', {data, source: window}))</script>" +
          `<script src="${url}"></script>`
      );
      inside.close();
      window.addEventListener("message", event => {
        if (event.source !== frame.contentWindow) return;
        this.dispatchEvent(new MessageEvent("message", { data: event.data }));
        if (this.onmessage) this.onmessage(event);
      });
      this.ready = new Promise(resolve => (frame.contentWindow.onload = resolve));
    }
    postMessage(data) {
      const inside = this.frame.contentWindow;
      this.ready.then(() => inside.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() {
      this.frame.remove();
    }
  };
}
