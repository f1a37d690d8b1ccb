// viser sorts the Gaussians by depth in a module worker from a blob: URL. In a page without an origin, from the disk or
// in a sandbox, browsers start such a worker from a data: URL only, and report it too late for viser, which falls back
// to a data: URL if the constructor throws.

if (self.origin === "null") {
  self.Worker = class extends Worker {
    /** @param {string | URL} url @param {WorkerOptions} [options] */
    constructor(url, options) {
      if (String(url).startsWith("blob:")) {
        throw new DOMException("no worker from a blob: URL here", "SecurityError");
      }
      super(url, options);
    }
  };
}
