// Mouse, touch and pen on the picture, and the keyboard.
const DEGREES = 0.35; // of a turn, for a CSS pixel
const CLICK = 5; // CSS pixels that a click may move

class Pointer {
  constructor(canvas, view, act) {
    Object.assign(this, { canvas, view, act });
    this.down = new Map(); // id -> {x, y, moved, what}
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event, true));
    canvas.addEventListener("pointercancel", (event) => this.release(event, false));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      act.zoom(Math.exp(clamp(event.deltaY * (event.deltaMode ? 20 : 1), -300, 300) * 1.5e-3));
    }, { passive: false });
    document.addEventListener("keydown", (event) => this.key(event));
  }

  place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  press(event) {
    const { view, canvas } = this, [x] = this.place(event), reach = event.pointerType === "touch" ? 24 : 12;
    const divider = view.mode === "wipe" && Math.abs(x - view.split) * canvas.clientWidth < reach;
    const light = event.button === 2 || event.shiftKey ? 0 : event.ctrlKey || event.altKey || event.metaKey ? 1 : null;
    const what = divider ? "split" : light ?? view.held;
    this.down.set(event.pointerId, { x: event.clientX, y: event.clientY, moved: 0, what, start: this.place(event) });
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
  }

  move(event) {
    const own = this.down.get(event.pointerId);
    if (!own) return;
    const right = event.clientX - own.x, down = event.clientY - own.y, others = [...this.down.values()].filter((one) => one !== own);
    if (others.length) {
      const apart = Math.hypot(own.x - others[0].x, own.y - others[0].y);
      const now = Math.hypot(event.clientX - others[0].x, event.clientY - others[0].y);
      this.act.zoom(apart / Math.max(now, 1));
      for (const other of others) other.moved = Infinity;
      own.moved = Infinity;
    }
    Object.assign(own, { x: event.clientX, y: event.clientY, moved: own.moved + Math.hypot(right, down) });
    if (others.length || own.moved < CLICK) return;
    if (own.what === "split") this.act.split(this.place(event)[0]);
    else this.act.turn(own.what, DEGREES * right, -DEGREES * down);
  }

  release(event, whole) {
    const own = this.down.get(event.pointerId);
    this.down.delete(event.pointerId);
    if (whole && own && own.moved < CLICK && event.button === 0) this.act.pick(...own.start);
    if (!this.down.size) this.act.rest();
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
    const { act, view } = this, step = event.shiftKey ? 15 : 3;
    const keys = {
      ArrowLeft: () => act.turn(view.held, -step, 0),
      ArrowRight: () => act.turn(view.held, step, 0),
      ArrowUp: () => act.turn(view.held, 0, step),
      ArrowDown: () => act.turn(view.held, 0, -step),
      "+": () => act.zoom(1 / 1.1),
      "=": () => act.zoom(1 / 1.1),
      "-": () => act.zoom(1.1),
      1: () => act.set("held", "camera"),
      2: () => act.set("held", 0),
      3: () => act.set("held", 1),
      "[": () => act.set("stops", view.stops - 0.5),
      "]": () => act.set("stops", view.stops + 0.5),
      ",": () => act.set("tiling", view.tiling / 2 ** 0.5),
      ".": () => act.set("tiling", view.tiling * 2 ** 0.5),
      t: () => act.next("tone"),
      m: () => act.next("shape"),
      w: () => act.set("mode", "wipe"),
      d: () => act.set("mode", "difference"),
      s: () => act.set("mode", "side"),
      o: () => act.set("mode", "one"),
      " ": () => act.swap(),
      "<": () => act.split(view.split - 0.05),
      ">": () => act.split(view.split + 0.05),
      p: () => act.pick(0.5, 0.5),
      r: () => act.reset(),
      "?": () => act.help(),
      Escape: () => act.forget(),
    };
    const pressed = keys[event.key];
    // A button that has the focus is pressed by the space bar, as everywhere.
    if (!pressed || (event.key === " " && event.target.tagName === "BUTTON")) return;
    event.preventDefault();
    pressed();
  }
}
