// The annotations as the program knows them, laid out in lanes: of a tier, overlapping ones below each other.

import { post } from "./api.js";
import { after } from "./signals.js";

export class Marks {
  constructor(document, changed, failed) {
    this.rows = new Map();
    this.tiers = new Map(); // tier: levels, each {ids, start, end} sorted and without overlap
    this.changed = changed;
    this.failed = failed;
    this.queue = Promise.resolve();
    this.take(document);
  }

  // Take an answer of the program: everything, or what came and went.
  take(answer) {
    const touched = new Set();
    if (answer.annotations) {
      for (const row of this.rows.values()) touched.add(row.tier);
      this.rows.clear();
    }
    for (const id of answer.removed ?? []) { touched.add(this.rows.get(id)?.tier); this.rows.delete(id); }
    for (const row of answer.annotations ?? answer.added ?? []) {
      touched.add(this.rows.get(row.id)?.tier);
      touched.add(row.tier);
      this.rows.set(row.id, row);
    }
    this.order = null;
    this.layOut(touched);
    Object.assign(this, { revision: answer.revision, unsaved: answer.unsaved, canUndo: answer.can_undo, canRedo: answer.can_redo });
  }

  layOut(tiers) {
    const members = new Map([...tiers].map((tier) => [tier, []]));
    for (const row of this.rows.values()) members.get(row.tier)?.push(row);
    for (const [tier, rows] of members) {
      if (!rows.length) { this.tiers.delete(tier); continue; }
      rows.sort((a, b) => a.start_ns - b.start_ns || b.end_ns - a.end_ns);
      const levels = [];
      for (const row of rows) {
        const free = levels.find((l) => l.free <= row.start_ns);
        const level = free ?? { ids: [], start: [], end: [], free: 0 };
        if (!free) levels.push(level);
        level.ids.push(row.id);
        level.start.push(row.start_ns);
        level.end.push(row.end_ns);
        level.free = Math.max(row.end_ns, row.start_ns + 1); // two instants at one time stand below each other
      }
      this.tiers.set(tier, levels);
    }
    this.tiers = new Map([...this.tiers].sort(([a], [b]) => (a < b ? -1 : 1)));
  }

  // Annotations of a level that touch a range of time, as places in it.
  static within(level, start, end) {
    return [after(level.end, start - 1), after(level.start, end)];
  }

  // One request after the other, in the order of the keys that were pressed.
  ask(name, document) {
    this.queue = this.queue.then(() => this.request(name, document));
    return this.queue;
  }

  // Save what was asked for so far; editing goes on meanwhile.
  save() { return this.queue.then(() => this.request("save")); }

  async request(name, document = {}) {
    try {
      const answer = await post(`/api/${name}`, { revision: this.revision, ...document });
      this.take(answer);
      this.changed(name, answer);
      return answer;
    } catch (error) {
      this.failed(error);
      return null;
    }
  }

  edit(add, remove = []) { return this.ask("edit", { add, remove }); }

  // Give an annotation other values.
  set(id, values) {
    const row = this.rows.get(id);
    if (!row || Object.keys(values).every((k) => row[k] === values[k])) return Promise.resolve(null);
    return this.edit([{ ...row, ...values }], [id]);
  }

  // In the order of time.
  sorted() {
    this.order ??= [...this.rows.values()].sort(byTime);
    return this.order;
  }

  // Those that touch a range of time: the first so many of each lane, in the order of time, and how many there are.
  seen(start, end, most, hidden) {
    let count = 0;
    const found = [];
    for (const [tier, levels] of this.tiers) {
      if (hidden.has(tier)) continue;
      for (const level of levels) {
        const [from, to] = Marks.within(level, start, end);
        count += Math.max(to - from, 0);
        for (let i = from; i < Math.min(to, from + most); i++) found.push(this.rows.get(level.ids[i]));
      }
    }
    return { rows: found.sort(byTime).slice(0, most), count };
  }
}

const byTime = (a, b) => a.start_ns - b.start_ns || a.end_ns - b.end_ns || (a.id < b.id ? -1 : 1);
