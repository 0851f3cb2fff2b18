// Times are nanoseconds since the start of the recording; the view says which of them a pixel shows.

export const SECOND = 1e9;

const STEPS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 43200];

export class View {
  constructor(first, last) {
    this.first = first;
    this.last = Math.max(last, first + 1);
    this.width = 1; // pixels
    this.whole();
  }
  whole() {
    const margin = (this.last - this.first) * 0.005;
    this.start = this.first - margin;
    this.end = this.last + margin;
  }
  get span() { return this.end - this.start; }
  get perPixel() { return this.span / this.width; }
  at(x) { return this.start + x * this.perPixel; }
  x(t) { return (t - this.start) / this.perPixel; }
  // A time that an annotation may have: whole nanoseconds inside the recording.
  inside(t) { return Math.round(Math.min(Math.max(t, this.first), this.last)); }
  zoom(factor, about) {
    const most = (this.last - this.first) * 1.1;
    const span = Math.min(Math.max(this.span * factor, 1e6), most);
    const share = (about - this.start) / this.span;
    this.start = about - share * span;
    this.end = this.start + span;
    this.pan(0);
  }
  pan(by) {
    const span = this.span;
    const middle = Math.min(Math.max(this.start + by + span / 2, this.first), this.last);
    this.start = middle - span / 2;
    this.end = this.start + span;
  }
  show(t) {
    if (t < this.start || t > this.end) this.pan(t - (this.start + this.span / 2));
  }
}

// Seconds as text, with so many digits as the step between two of them needs.
export function seconds(t, step = 1e6) {
  const digits = Math.min(Math.max(0, Math.ceil(-Math.log10(step / SECOND))), 9);
  return (t / SECOND).toFixed(digits);
}

// A time on the axis: seconds of a short recording, hours, minutes and seconds of a long one.
export function clock(t, step, long) {
  if (!long) return seconds(t, step);
  const sign = t < 0 ? "-" : "";
  const whole = Math.abs(t) / SECOND;
  const digits = Math.min(Math.max(0, Math.ceil(-Math.log10(step / SECOND))), 3);
  const s = (whole % 60).toFixed(digits).padStart(digits ? digits + 3 : 2, "0");
  return `${sign}${Math.floor(whole / 3600)}:${String(Math.floor((whole % 3600) / 60)).padStart(2, "0")}:${s}`;
}

export function ticks(view) {
  const least = (view.perPixel * 90) / SECOND;
  const step = (STEPS.find((s) => s >= least) ?? STEPS.at(-1)) * SECOND;
  const found = [];
  for (let k = Math.ceil(view.start / step); k * step <= view.end; k++) found.push(k * step);
  return { step, at: found };
}
