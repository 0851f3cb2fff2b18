// Channels as smallest and largest values over blocks, coarse to fine. What is seen is asked for; until it is
// there, the next coarser level is drawn in its place.

import { getBytes } from "./api.js";

const MOST_TILES = 96; // a channel

export class Channel {
  constructor(topic, columns, changed) {
    this.topic = topic;
    this.columns = columns;
    this.changed = changed;
    this.tiles = new Map();
    this.pending = new Set();
    this.top = null;
    this.complete = false;
  }

  // Ask for the coarsest level until the channel is read to its end.
  async load() {
    while (!this.complete) {
      const { about, bytes } = await getBytes(`/api/overview?topic=${encodeURIComponent(this.topic)}`, "X-Marcha-Level");
      Object.assign(this, { sizes: about.sizes, origin: about.origin, block: about.block, factor: about.factor, tileSize: about.tile });
      this.top = unpack(bytes, about.count, this.columns, false);
      this.levels = about.sizes.length;
      this.complete = about.complete;
      if (this.complete) this.interval = usual(this.top, this.rowsPerBlock());
      this.changed();
      if (!this.complete) await new Promise((r) => setTimeout(r, 120));
    }
  }

  rowsPerBlock(level = this.levels) {
    return level === 0 ? 1 : this.block * this.factor ** (level - 1);
  }

  // The coarsest level whose blocks are no wider than a pixel.
  level(view) {
    const rows = view.perPixel / this.interval;
    let level = this.levels;
    while (level > 0 && this.rowsPerBlock(level) > Math.max(rows, 1)) level--;
    return level;
  }

  // Pieces of tiles that together show the view: {tile, from, to, rows}, from and to inclusive.
  cover(view) {
    const { top } = this;
    if (!top || !top.count) return [];
    const first = Math.max(after(top.first, view.start) - 2, 0);
    const last = Math.min(after(top.first, view.end), top.count - 1);
    if (!this.complete) return [{ tile: top, from: first, to: last, rows: Infinity }];
    const level = this.level(view);
    const out = [];
    const ratio = this.rowsPerBlock() / this.rowsPerBlock(level);
    const most = level > 0 ? this.sizes[level - 1] - 1 : this.sizes[0] * this.block - 1;
    this.gather(level, first * ratio, Math.min((last + 1) * ratio - 1, most), out);
    return out;
  }

  gather(level, first, last, out) {
    if (level === this.levels) {
      out.push({ tile: this.top, from: first, to: Math.min(last, this.top.count - 1), rows: this.rowsPerBlock() });
      return;
    }
    for (let index = Math.floor(first / this.tileSize); index <= Math.floor(last / this.tileSize); index++) {
      const base = index * this.tileSize;
      const from = Math.max(first - base, 0);
      const to = Math.min(last - base, this.tileSize - 1);
      const tile = this.tile(level, index);
      if (tile) {
        if (from < tile.count) out.push({ tile, from, to: Math.min(to, tile.count - 1), rows: this.rowsPerBlock(level) });
      } else {
        const ratio = level === 0 ? this.block : this.factor;
        this.gather(level + 1, Math.floor((base + from) / ratio), Math.floor((base + to) / ratio), out);
      }
    }
  }

  tile(level, index) {
    const key = `${level}/${index}`;
    const found = this.tiles.get(key);
    if (found) {
      this.tiles.delete(key); // the newest stand last
      this.tiles.set(key, found);
    } else if (!this.pending.has(key)) {
      this.fetch(key, level, index);
    }
    return found;
  }

  async fetch(key, level, index) {
    this.pending.add(key);
    const path = `/api/tile?topic=${encodeURIComponent(this.topic)}&level=${level}&index=${index}`;
    try {
      const { about, bytes } = await getBytes(path, "X-Marcha-Count");
      this.tiles.set(key, unpack(bytes, about, this.columns, level === 0));
      while (this.tiles.size > MOST_TILES) this.tiles.delete(this.tiles.keys().next().value);
      this.changed();
      this.pending.delete(key);
    } catch {
      setTimeout(() => this.pending.delete(key), 1000); // asked for again when it is seen again
    }
  }
}

function unpack(bytes, count, columns, rows) {
  const first = new Float64Array(bytes, 0, count);
  const last = rows ? first : new Float64Array(bytes, 8 * count, count);
  let at = (rows ? 8 : 16) * count;
  const series = () => Array.from({ length: columns }, () => {
    const values = new Float32Array(bytes, at, count);
    at += 4 * count;
    return values;
  });
  const low = series();
  return { count, first, last, low, high: rows ? low : series() };
}

// How many of sorted times are not after t.
export function after(times, t) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle + 1;
    else high = middle;
  }
  return low;
}

// The usual time between two rows: the median over blocks, so that gaps do not count.
function usual(top, rows) {
  const each = Array.from(top.first, (t, i) => (top.last[i] - t) / (rows - 1)).filter((d) => d > 0).sort((a, b) => a - b);
  return each.length ? each[each.length >> 1] : 1e9;
}
