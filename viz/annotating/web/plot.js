// Signals on the canvas: dense ones as the range of values in each column of pixels, written straight into the
// picture; sparse ones as lines from row to row.

const GAP = 3; // no line over more than so many usual intervals
const SPARSE = 3; // rows a pixel up to which lines are drawn: they are smooth, ranges of values are quick

export class Plot {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
  }

  // Draw panels into their boxes: {panel, channel, left, top, width, height}, pixels of the canvas.
  draw(boxes, view, fit) {
    const { canvas, context } = this;
    const { width, height } = canvas;
    if (!width || !height) return;
    if (this.image?.width !== width || this.image?.height !== height) {
      this.image = context.createImageData(width, height);
      this.pixels = new Uint32Array(this.image.data.buffer);
    }
    this.pixels.fill(0);
    const lines = [];
    for (const box of boxes) {
      const pieces = box.channel.cover(view);
      const series = pieces.length ? box.panel.columns.map((c) => this.ranges(box, pieces, view, c)) : [];
      box.range = range(box, series, fit);
      if (!box.range) continue;
      const sparse = pieces.length && pieces.every((p) => p.rows === 1) && rowsSeen(pieces) < SPARSE * box.width;
      for (let k = series.length - 1; k >= 0; k--) {
        if (sparse) lines.push([box, pieces, box.panel.columns[k]]);
        else this.fill(box, series[k], box.panel.columns[k].color);
      }
    }
    context.putImageData(this.image, 0, 0);
    for (const line of lines) this.line(...line, view);
  }

  // Smallest and largest value of a column in each column of pixels; +-Infinity where there is none.
  ranges(box, pieces, view, column) {
    const { width } = box;
    const more = shift(box, column);
    const low = new Float64Array(width).fill(Infinity);
    const high = new Float64Array(width).fill(-Infinity);
    const scale = width / view.span;
    for (const { tile, from, to } of pieces) {
      const lows = tile.low[column.index], highs = tile.high[column.index];
      for (let i = from; i <= to; i++) {
        const a = lows[i] + more, b = highs[i] + more;
        if (!(a <= b)) continue; // NaN
        let x = Math.floor((tile.first[i] - view.start) * scale);
        const end = Math.min(Math.floor((tile.last[i] - view.start) * scale), width - 1);
        for (x = Math.max(x, 0); x <= end; x++) {
          if (a < low[x]) low[x] = a;
          if (b > high[x]) high[x] = b;
        }
      }
    }
    return { low, high };
  }

  fill(box, { low, high }, color) {
    const { pixels } = this;
    const stride = this.canvas.width;
    const paint = packed(color);
    const y = scaleOf(box);
    let top = -1, bottom = -1; // of the column before
    for (let x = 0; x < box.width; x++) {
      if (low[x] > high[x]) { top = -1; continue; }
      let a = clamp(Math.round(y(high[x])), box), b = clamp(Math.round(y(low[x])), box);
      const a0 = a, b0 = b;
      if (top >= 0) { // a steep signal has no holes between two columns
        if (a > bottom) a = bottom + 1;
        else if (b < top) b = top - 1;
      }
      top = a0; bottom = b0;
      for (let at = a * stride + box.left + x, k = a; k <= b; k++, at += stride) pixels[at] = paint;
    }
  }

  line(box, pieces, column, view) {
    const { context } = this;
    const y = scaleOf(box);
    const gap = GAP * box.channel.interval;
    const more = shift(box, column);
    context.save();
    context.beginPath();
    context.rect(box.left, box.top, box.width, box.height);
    context.clip();
    context.beginPath();
    const scale = box.width / view.span;
    const dots = rowsSeen(pieces) < box.width / 8;
    const at = [];
    let before = -Infinity;
    for (const { tile, from, to } of pieces) {
      const values = tile.low[column.index];
      for (let i = from; i <= to; i++) {
        const t = tile.first[i];
        if (Number.isNaN(values[i])) { before = -Infinity; continue; }
        const x = box.left + (t - view.start) * scale, v = y(values[i] + more);
        if (t - before > gap) context.moveTo(x, v);
        else context.lineTo(x, v);
        if (dots || t - before > gap) at.push(x, v);
        before = t;
      }
    }
    context.strokeStyle = context.fillStyle = column.color;
    context.lineWidth = 1.4 * (window.devicePixelRatio || 1);
    context.stroke();
    for (let k = 0; k < at.length; k += 2) context.fillRect(at[k] - 1.5, at[k + 1] - 1.5, 3, 3);
    context.restore();
  }
}

const rowsSeen = (pieces) => pieces.reduce((sum, p) => sum + p.to - p.from + 1, 0);
const clamp = (y, box) => Math.min(Math.max(y, box.top), box.top + box.height - 1);

const fallback = (value, other) => (Number.isNaN(value) ? other : value);

// What turns a column's values, which are less its own origin, into values less that of the panel's first column.
const shift = (box, column) => box.channel.origin[column.index] - box.channel.origin[box.panel.columns[0].index];

// Such a value to pixel; all columns of a panel share its range.
function scaleOf(box) {
  const { low, high } = box.range;
  const scale = (box.height - 1) / (high - low);
  return (value) => box.top + (high - value) * scale;
}

// Range of a panel in such values: what is seen, or the whole recording.
function range(box, series, fit) {
  const { top } = box.channel;
  if (!top) return null;
  let low = Infinity, high = -Infinity;
  if (fit) {
    for (const s of series) for (let x = 0; x < box.width; x++) { low = Math.min(low, s.low[x]); high = Math.max(high, s.high[x]); }
  } else {
    if (box.panel.known?.top === top) return box.panel.known.range;
    for (const column of box.panel.columns) {
      const more = shift(box, column);
      for (let i = 0; i < top.count; i++) {
        low = Math.min(low, fallback(top.low[column.index][i] + more, low));
        high = Math.max(high, fallback(top.high[column.index][i] + more, high));
      }
    }
  }
  if (!(low <= high)) return null;
  const margin = (high - low) * 0.05 || Math.abs(high) * 0.05 || 1;
  const found = { low: low - margin, high: high + margin };
  if (!fit) box.panel.known = { top: box.channel.top, range: found };
  return found;
}

const cache = new Map();
function packed(color) {
  if (!cache.has(color)) {
    const n = parseInt(color.slice(1), 16);
    cache.set(color, ((0xff << 24) | ((n & 0xff) << 16) | (n & 0xff00) | (n >> 16)) >>> 0);
  }
  return cache.get(color);
}
