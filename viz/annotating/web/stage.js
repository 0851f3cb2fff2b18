// What is drawn around the signals: grid and scales behind them, lanes of annotations above, cursor and what is
// being dragged in front.

import { Marks } from "./marks.js";
import { Plot } from "./plot.js";
import { lastPart } from "./side.js";
import { clock, ticks } from "./time.js";

const LEFT = 64, AXIS = 22, STRIP = 24, LANE = 18, PAD = 6, GRIP = 5; // pixels of the page

export class Stage {
  constructor(element, app) {
    this.element = element;
    this.app = app;
    const [back, signals, front] = element.querySelectorAll("canvas");
    Object.assign(this, { back, front, plot: new Plot(signals) });
    this.contexts = [back.getContext("2d"), front.getContext("2d")];
    this.dirty = true;
    new ResizeObserver(() => this.resize()).observe(element);
    this.resize();
    const frame = () => {
      if (this.dirty) { this.dirty = this.frontDirty = false; this.drawAll(); }
      else if (this.frontDirty) { this.frontDirty = false; this.drawFront(); }
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  resize() {
    this.ratio = window.devicePixelRatio || 1;
    this.width = this.element.clientWidth;
    this.height = this.element.clientHeight;
    for (const canvas of [this.back, this.plot.canvas, this.front]) {
      canvas.width = Math.round(this.width * this.ratio);
      canvas.height = Math.round(this.height * this.ratio);
    }
    for (const context of this.contexts) context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    this.app.view.width = Math.max(this.width - LEFT, 1);
    this.dirty = true;
  }

  // ------------------------------------------------------------------------------------------------ layout

  layOut() {
    const lanes = [];
    for (const [tier, levels] of this.app.marks.tiers) {
      if (!this.app.hidden.has(tier)) levels.forEach((level, k) => lanes.push({ tier, level, k }));
    }
    const each = Math.max(Math.min(LANE, (this.height * 0.4) / Math.max(lanes.length, 1)), 4);
    lanes.forEach((lane, k) => Object.assign(lane, { top: PAD + k * each, height: each }));
    this.lanes = lanes;
    this.lanesEnd = PAD + lanes.length * each + (lanes.length ? PAD : 0);
    this.axisTop = this.height - STRIP - AXIS;
    const open = this.app.panels.filter((p) => p.open);
    const panel = (this.axisTop - this.lanesEnd) / Math.max(open.length, 1);
    const r = this.ratio;
    this.boxes = open.map((p, k) => ({
      panel: p,
      channel: this.app.channel(p.topic),
      left: Math.round(LEFT * r),
      top: Math.round((this.lanesEnd + k * panel + 3) * r),
      width: Math.max(Math.round(this.width * r) - Math.round(LEFT * r), 1),
      height: Math.max(Math.round((panel - 6) * r), 2),
    }));
  }

  // What lies under a pixel: {part, t, id, grip}; part is lanes, signals, axis, strip or scale.
  under(x, y) {
    const { view, marks, selected } = this.app;
    const t = view.at(x - LEFT);
    if (y >= this.axisTop + AXIS) return { part: "strip", t: this.stripTime(x) };
    if (y >= this.axisTop) return { part: "axis", t };
    if (x < LEFT) return { part: "scale", t };
    if (y < this.lanesEnd) {
      const lane = this.lanes.find((l) => y >= l.top && y < l.top + l.height);
      if (!lane) return { part: "lanes", t };
      const { level, tier } = lane;
      const reach = GRIP * view.perPixel;
      const [from, to] = Marks.within(level, t - reach, t + reach);
      let best = null;
      for (let i = from; i < to; i++) {
        const width = (level.end[i] - level.start[i]) / view.perPixel;
        const far = Math.max(level.start[i] - t, t - level.end[i], 0) / view.perPixel;
        const grip = width < 3 * GRIP ? "all"
          : Math.abs(level.start[i] - t) < reach ? "start" : Math.abs(level.end[i] - t) < reach ? "end" : "all";
        if (!best || far < best.far) best = { far, part: "lanes", t, tier, id: level.ids[i], grip };
      }
      return best ?? { part: "lanes", t, tier };
    }
    const row = marks.rows.get(selected);
    if (row && row.end_ns > row.start_ns) {
      for (const grip of ["start", "end"]) {
        if (Math.abs(view.x(row[`${grip}_ns`]) + LEFT - x) < GRIP) return { part: "signals", t, id: row.id, grip };
      }
    }
    return { part: "signals", t };
  }

  stripTime(x) {
    const { first, last } = this.app.view;
    return first + ((x - LEFT) / Math.max(this.width - LEFT, 1)) * (last - first);
  }

  // ----------------------------------------------------------------------------------------------- drawing

  drawAll() {
    this.layOut();
    this.plot.draw(this.boxes, this.app.view, this.app.fit);
    this.drawBack();
    this.drawFront();
    this.app.drawn();
  }

  drawBack() {
    const [context] = this.contexts;
    const { view } = this.app;
    context.clearRect(0, 0, this.width, this.height);
    context.font = "11px system-ui, 'DejaVu Sans', sans-serif";
    context.textBaseline = "middle";
    context.lineWidth = 1;
    const found = ticks(view);
    const long = view.last - view.first > 600e9;
    context.strokeStyle = "#e6e6e6";
    context.beginPath();
    for (const t of found.at) {
      const x = Math.round(LEFT + view.x(t)) + 0.5;
      if (x >= LEFT) { context.moveTo(x, this.lanesEnd); context.lineTo(x, this.axisTop); }
    }
    context.stroke();
    context.fillStyle = "#444";
    context.textAlign = "center";
    for (const t of found.at) {
      const x = LEFT + view.x(t);
      if (x > LEFT + 20 && x < this.width - 20) context.fillText(clock(t, found.step, long), x, this.axisTop + AXIS / 2);
    }
    context.textAlign = "right";
    context.fillText(long ? "h:mm:ss" : "time (s)", LEFT - 6, this.axisTop + AXIS / 2);
    for (const box of this.boxes) this.drawScale(context, box);
    this.drawLanes(context);
  }

  drawScale(context, box) {
    const top = box.top / this.ratio, height = box.height / this.ratio;
    context.strokeStyle = "#bbb";
    context.strokeRect(LEFT + 0.5, Math.round(top) + 0.5, this.width - LEFT - 1, Math.round(height));
    const { panel, range } = box;
    context.textAlign = "right";
    context.fillStyle = "#444";
    if (range) {
      const factor = panel.columns[0].factor;
      const base = box.channel.origin[panel.columns[0].index];
      const low = (base + range.low) * factor, high = (base + range.high) * factor;
      const step = nice((high - low) / Math.max(height / 26, 1));
      const digits = Math.min(Math.max(0, Math.ceil(-Math.log10(step))), 8);
      for (let k = Math.ceil(low / step); k * step <= high; k++) {
        const y = top + ((high - k * step) / (high - low)) * height;
        if (y < top + 5 || y > top + height - 5) continue;
        context.fillText((k * step).toFixed(digits), LEFT - 6, y);
        context.fillRect(LEFT - 3, Math.round(y), 3, 1);
      }
    } else {
      context.fillText(box.channel.failed ? "unreadable" : "reading …", LEFT - 6, top + height / 2);
    }
  }

  // Names of what is drawn, over the signals.
  drawLegend(context, box) {
    const y = box.top / this.ratio + 9;
    const { panel } = box;
    const words = [[`${panel.topic} (${panel.unit || "no unit"})`, "#1b1b1b"], ...panel.columns.map((c) => [c.name, c.color])];
    let x = LEFT + 8;
    context.textAlign = "left";
    const width = words.reduce((sum, [word]) => sum + context.measureText(word).width + 12, 0);
    context.fillStyle = "rgba(255,255,255,0.8)";
    context.fillRect(x - 4, y - 8, Math.min(width, this.width - x), 16);
    for (const [word, color] of words) {
      context.fillStyle = color;
      context.fillText(word, x, y);
      x += context.measureText(word).width + 12;
    }
  }

  drawLanes(context) {
    const { view, marks } = this.app;
    context.save();
    for (const { tier, level, k, top, height } of this.lanes) {
      const color = this.app.colorOf(tier);
      if (k === 0 && height >= 9) {
        context.textAlign = "right";
        context.fillStyle = color;
        context.fillText(shortened(context, lastPart(tier), LEFT - 8), LEFT - 6, top + height / 2);
      }
      context.fillStyle = "#f4f4f4";
      context.fillRect(LEFT, top, this.width - LEFT, height - 1);
      const [from, to] = Marks.within(level, view.start, view.end);
      let reached = -Infinity;
      for (let i = from; i < to; i++) {
        const instant = level.start[i] === level.end[i];
        const a = Math.max(LEFT + view.x(level.start[i]), LEFT), b = LEFT + view.x(level.end[i]);
        if (Math.max(b, a + 1) < reached + 1) continue; // less than a pixel further than the last one
        reached = Math.max(b, a + 1);
        context.fillStyle = color;
        if (instant) {
          const half = Math.min(height / 2 - 1, 6), y = top + height / 2 - 0.5;
          context.beginPath();
          context.moveTo(a, y - half); context.lineTo(a + half * 0.7, y); context.lineTo(a, y + half); context.lineTo(a - half * 0.7, y);
          context.fill();
        } else {
          context.fillRect(a, top, Math.max(b - a, 1), height - 1);
        }
        const room = Math.min(b, this.width) - a - 8;
        if (height < 12 || (!instant && room < 14)) continue;
        const next = i + 1 < level.start.length ? LEFT + view.x(level.start[i + 1]) - a - 12 : 200;
        const text = shortened(context, marks.rows.get(level.ids[i])?.label ?? "", instant ? Math.min(next, 120) : room);
        context.textAlign = "left";
        context.fillStyle = instant ? "#222" : "#fff";
        context.fillText(text, a + (instant ? 8 : 4), top + height / 2);
      }
    }
    context.restore();
  }

  drawFront() {
    const context = this.contexts[1];
    const { view, marks, selected, cursor, pending, drag } = this.app;
    context.clearRect(0, 0, this.width, this.height);
    context.font = "11px system-ui, 'DejaVu Sans', sans-serif";
    context.textBaseline = "middle";
    for (const box of this.boxes ?? []) this.drawLegend(context, box);
    context.save();
    context.beginPath();
    context.rect(LEFT, 0, this.width - LEFT, this.axisTop);
    context.clip();
    const row = marks.rows.get(selected);
    const shown = drag?.row ?? row;
    if (shown) this.range(context, shown.start_ns, shown.end_ns, this.app.colorOf(shown.tier), shown.id);
    if (drag?.from !== undefined) this.range(context, Math.min(drag.from, drag.to), Math.max(drag.from, drag.to), "#333333");
    if (pending !== null) this.range(context, Math.min(pending, cursor), Math.max(pending, cursor), "#333333");
    const x = Math.round(LEFT + view.x(cursor)) + 0.5;
    context.strokeStyle = "#c2185b";
    context.beginPath();
    context.moveTo(x, 0);
    context.lineTo(x, this.axisTop);
    context.stroke();
    context.restore();
    this.drawStrip(context);
  }

  range(context, start, end, color, id) {
    const a = LEFT + this.app.view.x(start), b = LEFT + this.app.view.x(end);
    context.fillStyle = `${color}2e`;
    context.fillRect(a, this.lanesEnd, b - a, this.axisTop - this.lanesEnd);
    context.fillStyle = color;
    for (const x of [a, b]) context.fillRect(Math.round(x) - 0.5, this.lanesEnd, 1.5, this.axisTop - this.lanesEnd);
    const lane = id && this.lanes.find((l) => l.level.ids.includes(id));
    if (lane) {
      context.strokeStyle = "#000";
      context.lineWidth = 2;
      context.strokeRect(a - 1, lane.top - 1, Math.max(b - a, 2) + 2, lane.height + 1);
      context.lineWidth = 1;
    }
  }

  // The whole recording, its annotations, and the part that is seen.
  drawStrip(context) {
    const { view, marks, cursor, hidden } = this.app;
    const top = this.axisTop + AXIS + 2, height = STRIP - 5, width = Math.max(this.width - LEFT, 1);
    const x = (t) => LEFT + ((t - view.first) / (view.last - view.first)) * width;
    context.fillStyle = "#eee";
    context.fillRect(LEFT, top, width, height);
    const tiers = [...marks.tiers].filter(([tier]) => !hidden.has(tier));
    const each = height / Math.max(tiers.length, 1);
    tiers.forEach(([tier, levels], k) => {
      context.fillStyle = this.app.colorOf(tier);
      for (const level of levels) {
        let reached = -1;
        for (let i = 0; i < level.ids.length; i++) {
          const a = x(level.start[i]), b = Math.max(x(level.end[i]), a + 1);
          if (b < reached + 1) continue;
          reached = b;
          context.fillRect(a, top + k * each, b - a, Math.max(each - 1, 1));
        }
      }
    });
    const a = Math.max(x(view.start), LEFT), b = Math.min(x(view.end), this.width);
    context.fillStyle = "rgba(47,143,208,0.18)";
    context.fillRect(a, top, Math.max(b - a, 2), height);
    context.strokeStyle = "#2f8fd0";
    context.strokeRect(a + 0.5, top + 0.5, Math.max(b - a - 1, 2), height - 1);
    context.fillStyle = "#c2185b";
    context.fillRect(x(cursor), top, 1, height);
  }
}

Stage.LEFT = LEFT;

function nice(step) {
  const power = 10 ** Math.floor(Math.log10(step));
  return power * ([1, 2, 5].find((f) => f * power >= step) ?? 10);
}

function shortened(context, text, room) {
  if (room < 12) return "";
  if (context.measureText(text).width <= room) return text;
  let end = Math.max(Math.floor((text.length * room) / context.measureText(text).width), 0);
  while (end > 0 && context.measureText(`${text.slice(0, end)}…`).width > room) end--;
  return end ? `${text.slice(0, end)}…` : "";
}
