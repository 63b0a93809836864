// Search without a server. Browsers start no worker from a file on a disk; a hidden frame takes its place here, which
// runs the same script and passes messages as a worker does.
if (location.protocol === "file:")
  window.Worker = class extends EventTarget {
    constructor(script) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      this.inside = new Promise(ready => (frame.onload = () => ready(frame.contentWindow)))
      document.documentElement.append(frame)
      this.inside.then(inside => {
        inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
        this.started = new Promise(ready => {
          const element = inside.document.createElement("script")
          element.src = script
          element.onload = ready
          inside.document.body.append(element)
        })
      })
    }

    async postMessage(data) {
      const inside = await this.inside
      await this.started
      inside.dispatchEvent(new inside.MessageEvent("message", { data }))
    }
  }
