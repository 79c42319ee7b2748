"use strict";
// The map seen from above: x to the right, y up, metres; drag, pinch, wheel and double-click change the view.
class MapCanvas {
  constructor(canvas) {
    this.canvas = canvas;
    this.grid = null; // {image, x_m, y_m, cell_m, width, height}
    this.robot = null;
    this.path = [];
    this.follow = false;
    this.view = null; // {x, y: centre in metres, scale: pixels per metre}; null: show all
    this.fingers = new Map();
    this.due = false;
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); this.fingers.set(e.pointerId, e); });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => this.fingers.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => this.drag(e));
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); this.zoom(Math.exp(-e.deltaY / 400), e.offsetX, e.offsetY); }, { passive: false });
    canvas.addEventListener("dblclick", () => { this.view = null; this.draw(); });
  }

  drag(e) {
    const before = this.fingers.get(e.pointerId);
    if (!before) return;
    const other = [...this.fingers.values()].find((f) => f.pointerId !== e.pointerId);
    this.fingers.set(e.pointerId, e);
    const v = this.view ??= this.whole();
    if (other) {
      const gap = (f) => Math.hypot(f.offsetX - other.offsetX, f.offsetY - other.offsetY) + 1;
      this.zoom(gap(e) / gap(before), (e.offsetX + other.offsetX) / 2, (e.offsetY + other.offsetY) / 2);
    } else {
      v.x -= (e.offsetX - before.offsetX) / v.scale;
      v.y += (e.offsetY - before.offsetY) / v.scale;
    }
    this.draw();
  }

  zoom(factor, px, py) {
    const v = this.view ??= this.whole();
    const scale = Math.min(Math.max(v.scale * factor, 1), 2000);
    const dx = px - this.canvas.clientWidth / 2, dy = py - this.canvas.clientHeight / 2;
    v.x += dx / v.scale - dx / scale;
    v.y -= dy / v.scale - dy / scale;
    v.scale = scale;
    this.draw();
  }

  whole() {
    const xs = [], ys = [];
    for (let i = 0; i + 1 < this.path.length; i += 2) { xs.push(this.path[i] / 100); ys.push(this.path[i + 1] / 100); }
    if (this.robot) { xs.push(this.robot.x_m - 1, this.robot.x_m + 1); ys.push(this.robot.y_m - 1, this.robot.y_m + 1); }
    const g = this.grid;
    if (g) { xs.push(g.x_m, g.x_m + g.width * g.cell_m); ys.push(g.y_m, g.y_m + g.height * g.cell_m); }
    if (!xs.length) { xs.push(-3, 3); ys.push(-3, 3); }
    const x0 = Math.min(...xs), x1 = Math.max(...xs), y0 = Math.min(...ys), y1 = Math.max(...ys);
    const scale = 0.94 * Math.min(this.canvas.clientWidth / (x1 - x0), this.canvas.clientHeight / (y1 - y0));
    return { x: (x0 + x1) / 2, y: (y0 + y1) / 2, scale };
  }

  draw() {
    if (this.due) return;
    this.due = true;
    requestAnimationFrame(() => { this.due = false; this.paint(); });
  }

  paint() {
    const c = this.canvas, ratio = window.devicePixelRatio || 1;
    const w = c.clientWidth, h = c.clientHeight;
    if (c.width !== Math.round(w * ratio) || c.height !== Math.round(h * ratio)) { c.width = Math.round(w * ratio); c.height = Math.round(h * ratio); }
    const v = { ...(this.view ?? this.whole()) };
    if (this.follow && this.robot) { v.x = this.robot.x_m; v.y = this.robot.y_m; }
    const g = c.getContext("2d"), colour = (name) => getComputedStyle(c).getPropertyValue(name);
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    const px = (x) => w / 2 + (x - v.x) * v.scale, py = (y) => h / 2 - (y - v.y) * v.scale;
    if (this.grid) {
      const m = this.grid, height = m.height * m.cell_m;
      g.imageSmoothingEnabled = false;
      g.drawImage(m.image, px(m.x_m), py(m.y_m + height), m.width * m.cell_m * v.scale, height * v.scale);
    }
    if (this.robot) {
      g.fillStyle = colour("--scan");
      const s = this.robot.scan_cm;
      for (let i = 0; i + 1 < s.length; i += 2) g.fillRect(px(s[i] / 100) - 1, py(s[i + 1] / 100) - 1, 2, 2);
    }
    g.strokeStyle = colour("--path");
    g.lineWidth = 2;
    g.beginPath();
    for (let i = 0; i + 1 < this.path.length; i += 2) g.lineTo(px(this.path[i] / 100), py(this.path[i + 1] / 100));
    g.stroke();
    if (this.robot) this.paintRobot(g, px(this.robot.x_m), py(this.robot.y_m), Math.max(0.2 * v.scale, 7), colour("--robot"));
    this.paintScale(g, h, v.scale);
  }

  paintRobot(g, x, y, size, colour) {
    g.save();
    g.translate(x, y);
    g.rotate(-this.robot.yaw_rad);
    g.fillStyle = colour;
    g.beginPath();
    g.moveTo(size * 1.3, 0); g.lineTo(-size, size * 0.8); g.lineTo(-size * 0.6, 0); g.lineTo(-size, -size * 0.8);
    g.fill();
    g.restore();
  }

  paintScale(g, h, scale) {
    const metres = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100].find((m) => m * scale > 60) ?? 100;
    g.strokeStyle = g.fillStyle = getComputedStyle(this.canvas).color;
    g.lineWidth = 2;
    g.strokeRect(12, h - 14, metres * scale, 0);
    g.font = "12px system-ui, sans-serif";
    g.fillText(`${metres} m`, 12, h - 20);
  }
}
