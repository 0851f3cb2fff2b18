// The page: one view of time, one cursor, one selected annotation; what the keys and buttons do.

import { getJson } from "./api.js";
import { Film } from "./film.js";
import { KEYS, listen as listenKeys } from "./keys.js";
import { Marks } from "./marks.js";
import { listen as listenMouse } from "./mouse.js";
import { details, listAnnotations, listPanels, listTiers, listenDetails } from "./side.js";
import { Channel } from "./signals.js";
import { Stage } from "./stage.js";
import { clock, seconds, View } from "./time.js";

const byId = (id) => document.getElementById(id);

class App {
  constructor(recording) {
    this.recording = recording;
    this.view = new View(recording.start, recording.end);
    this.cursor = recording.start;
    this.selected = null;
    this.pending = null; // start of a stretch that m began
    this.drag = null;
    this.copied = null;
    this.fit = false;
    this.hidden = new Set();
    this.vocabularies = recording.vocabularies;
    this.colors = new Map();
    this.channels = new Map();
    this.panels = recording.panels;
    this.marks = new Marks(recording, (name, answer) => this.changed(name, answer), (e) => this.failed(e));
    // tiers of people before those of runs: there are fewer colours than tiers may be
    for (const tier of [...this.marks.tiers.keys()].sort((a, b) => a.includes("/") - b.includes("/"))) this.colorOf(tier);
    const places = new Map();
    for (const panel of this.panels) {
      const place = places.get(panel.topic) ?? 0;
      panel.columns.forEach((c, k) => Object.assign(c, { index: place + k }));
      places.set(panel.topic, place + panel.columns.length);
    }
    this.columns = places;
    this.stage = new Stage(byId("stage"), this);
    this.film = new Film(recording.video, this);
    listenMouse(this.stage, this);
    listenKeys(this);
    listenDetails(this);
    this.buttons();
    listPanels(this);
    byId("name").textContent = recording.name;
    document.title = `${recording.name}: annotate`;
    if (recording.taken_up) this.say(`took up ${recording.taken_up} edits of an earlier session that were not saved`);
    this.refresh();
    this.stage.element.focus();
  }

  // The channel of a topic; read from the first time that a panel of it is open.
  channel(topic) {
    if (!this.channels.has(topic)) {
      const channel = new Channel(topic, this.columns.get(topic), () => { this.stage.dirty = true; });
      this.channels.set(topic, channel);
      channel.load().catch((error) => { channel.failed = true; this.failed(error); });
    }
    return this.channels.get(topic);
  }

  colorOf(tier) {
    if (!this.colors.has(tier)) this.colors.set(tier, this.recording.colors[this.colors.size % this.recording.colors.length]);
    return this.colors.get(tier);
  }

  tier() { return byId("tier").value.trim() || "manual"; }

  labelsOf(tier) {
    const known = Object.keys(this.vocabularies[tier]?.labels ?? {});
    if (this.vocabularies[tier]?.closed) return known;
    const used = new Set();
    for (const row of this.marks.rows.values()) if (row.tier === tier && used.size < 50) used.add(row.label);
    return [...new Set([...known, ...[...used].sort()])];
  }

  // ----------------------------------------------------------------------------------------------- editing

  async mark(start, end) {
    const answer = await this.marks.edit([{ tier: this.tier(), label: byId("label").value, start_ns: start, end_ns: end }]);
    if (answer?.added?.length) this.select(answer.added[0].id);
  }

  beginOrEnd() {
    if (this.pending === null) {
      this.pending = this.cursor;
      this.say(`a stretch begins at ${seconds(this.cursor)} s; m ends it, Esc leaves it`);
    } else {
      const [start, end] = [Math.min(this.pending, this.cursor), Math.max(this.pending, this.cursor)];
      this.pending = null;
      this.mark(start, end);
    }
    this.stage.frontDirty = true;
  }

  change(id, values) { return this.marks.set(id, values); }

  edge(name) {
    const row = this.row();
    if (!row) return;
    const other = name === "start" ? row.end_ns : row.start_ns;
    this.change(row.id, { start_ns: Math.min(this.cursor, other), end_ns: Math.max(this.cursor, other) });
  }

  move() {
    const row = this.row();
    if (row) this.change(row.id, { start_ns: this.cursor, end_ns: this.cursor + row.end_ns - row.start_ns });
  }

  number(k) {
    const row = this.row();
    const label = this.labelsOf(row?.tier ?? this.tier())[k];
    if (label === undefined) return;
    if (row) this.change(row.id, { label });
    byId("label").value = label;
  }

  remove() { if (this.selected) this.marks.edit([], [this.selected]); }

  copy() {
    this.copied = this.row();
    if (this.copied) this.say(`copied ${JSON.stringify(this.copied.label)}; Ctrl+V pastes it at the cursor`);
    this.refresh();
  }

  async paste() {
    if (!this.copied) return;
    const { tier, label, note, confidence, channel, metadata, start_ns, end_ns } = this.copied;
    const start = this.cursor;
    const answer = await this.marks.edit([{ tier, label, note, confidence, channel, metadata, start_ns: start, end_ns: start + end_ns - start_ns }]);
    if (answer?.added?.length) this.select(answer.added[0].id);
  }

  undo() { return this.marks.ask("undo"); }
  redo() { return this.marks.ask("redo"); }

  save() {
    this.say("saving …");
    return this.marks.save();
  }

  // ----------------------------------------------------------------------------------------------- looking

  row() { return this.marks.rows.get(this.selected) ?? null; }

  select(id) {
    this.selected = id;
    this.refresh();
  }

  step(by) {
    const rows = this.marks.sorted().filter((r) => !this.hidden.has(r.tier));
    if (!rows.length) return;
    const at = rows.findIndex((r) => r.id === this.selected);
    const next = at >= 0 ? at + by
      : by > 0 ? rows.findIndex((r) => r.start_ns >= this.cursor) : rows.findLastIndex((r) => r.start_ns <= this.cursor);
    if (next < 0 || next >= rows.length) return;
    this.select(rows[next].id);
    this.setCursor(rows[next].start_ns);
  }

  setCursor(t, { film = false } = {}) {
    this.cursor = this.view.inside(t);
    const before = this.view.start;
    this.view.show(this.cursor);
    if (this.view.start !== before) this.stage.dirty = true;
    this.stage.frontDirty = true;
    if (!film) this.film.seek(this.cursor);
    this.where();
  }

  hover(t) { this.where(this.view.inside(t)); }

  zoom(factor) { this.view.zoom(factor, this.cursor); this.stage.dirty = true; }
  page(by) { this.view.pan(by * this.view.span * 0.9); this.stage.dirty = true; }
  whole() { this.view.whole(); this.stage.dirty = true; }

  showSelected(closer = true) {
    const row = this.row();
    if (!row) return;
    if (closer) {
      const span = Math.max((row.end_ns - row.start_ns) * 3, 1e9);
      this.view.zoom(span / this.view.span, row.start_ns);
    }
    this.view.pan((row.start_ns + row.end_ns) / 2 - (this.view.start + this.view.span / 2));
    this.setCursor(row.start_ns);
    this.stage.dirty = true;
  }

  setFit(fit) {
    this.fit = fit;
    byId("fit").checked = fit;
    this.stage.dirty = true;
  }

  // Usual time between two rows of the first open panel.
  sample() {
    const panel = this.panels.find((p) => p.open);
    return (panel && this.channel(panel.topic).interval) || 1e7;
  }

  leave() {
    this.pending = null;
    this.drag = null;
    this.select(null);
  }

  toStage() { this.stage.element.focus(); }
  focusField(id) { byId(id).focus(); byId(id).select(); }
  focusDetails(name) {
    const form = byId("details");
    if (form.hidden) return;
    form[name].focus();
    form[name].select();
  }
  help() { byId("keys").showModal(); }

  // ------------------------------------------------------------------------------------------------ saying

  say(text, wrong = false) {
    const said = byId("said");
    said.textContent = text;
    said.className = wrong ? "wrong" : "";
  }

  failed(error) {
    this.say(error.message, true);
    this.stage.frontDirty = true;
  }

  changed(name, answer) {
    const words = (row) => `${JSON.stringify(row.label)} in ${row.tier}, ${seconds(row.start_ns)}`
      + (row.end_ns > row.start_ns ? ` to ${seconds(row.end_ns)} s` : " s");
    if (name === "save") this.say(answer.change ? `saved ${answer.saved}` : "nothing to save: the recording has it all");
    else if (answer.added?.length === 1) this.say(`${name === "edit" ? "" : `${name}: `}${words(answer.added[0])}`);
    else if (answer.removed?.length) this.say(`${name === "edit" ? "removed" : `${name}: removed`} ${answer.removed.length}`);
    else if (name !== "edit") this.say(answer.added?.length === 0 ? `nothing to ${name}` : name);
    this.refresh();
  }

  where(t = this.cursor) {
    const long = this.view.last > 600e9 ? ` (${clock(t, 1e6, true)})` : "";
    byId("where").textContent = `${seconds(t)} s${long} · cursor ${seconds(this.cursor)} s`;
  }

  refresh() {
    const { marks } = this;
    if (this.selected && !marks.rows.has(this.selected)) this.selected = null;
    byId("undo").disabled = !marks.canUndo;
    byId("redo").disabled = !marks.canRedo;
    byId("copy").disabled = byId("delete").disabled = !this.selected;
    byId("paste").disabled = !this.copied;
    byId("save").classList.toggle("due", marks.unsaved > 0);
    byId("saved").textContent = marks.unsaved ? `${marks.unsaved} not saved` : "all saved";
    listTiers(this);
    details(this);
    this.stage.dirty = true;
    this.where();
  }

  // After each drawing: the list follows the view, but not at every frame.
  drawn() {
    if (this.listing) return;
    this.listing = setTimeout(() => { this.listing = null; listAnnotations(this); }, 150);
  }

  buttons() {
    const press = {
      mark: () => this.beginOrEnd(), instant: () => this.mark(this.cursor, this.cursor), copy: () => this.copy(),
      paste: () => this.paste(), delete: () => this.remove(), undo: () => this.undo(), redo: () => this.redo(),
      save: () => this.save(), out: () => this.zoom(1 / 0.7), in: () => this.zoom(0.7), whole: () => this.whole(),
      help: () => this.help(),
    };
    for (const [id, act] of Object.entries(press)) byId(id).addEventListener("click", act);
    byId("fit").addEventListener("change", (event) => this.setFit(event.target.checked));
    byId("tier").addEventListener("change", () => this.refresh());
    byId("keys").querySelector("dl").append(...KEYS.flatMap(([key, text]) => [
      Object.assign(document.createElement("dt"), { textContent: key }),
      Object.assign(document.createElement("dd"), { textContent: text }),
    ]));
  }
}

getJson("/api/recording").then(
  (recording) => { window.marcha = new App(recording); },
  (error) => { byId("said").textContent = error.message; byId("said").className = "wrong"; },
);
