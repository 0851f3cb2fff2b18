// What stands beside the signals: which panels and tiers are shown, the selected annotation, the list.

import { SECOND, seconds } from "./time.js";

const MOST = 200; // rows of the list
const byId = (id) => document.getElementById(id);

function checkbox(text, checked, color, changed) {
  const label = document.createElement("label");
  const box = Object.assign(document.createElement("input"), { type: "checkbox", checked });
  box.addEventListener("change", () => changed(box.checked));
  label.append(box, " ");
  if (color) {
    const chip = Object.assign(document.createElement("span"), { className: "chip" });
    chip.style.background = color;
    label.append(chip);
  }
  const words = document.createElement("bdi");
  words.textContent = text;
  label.append(words);
  label.title = text;
  return label;
}

export function listPanels(app) {
  const box = (panel) => checkbox(`${panel.topic} ${panel.name}`, panel.open, null, (open) => {
    panel.open = open;
    app.stage.dirty = true;
  });
  const result = (panel) => /^\/(estimate|reference)\//.test(panel.topic);
  byId("panels").replaceChildren(...app.panels.filter((p) => !result(p)).map(box));
  byId("results").replaceChildren(...app.panels.filter(result).map(box));
  byId("results").parentElement.hidden = !app.panels.some(result);
  byId("topics").replaceChildren(...[...new Set(app.panels.map((p) => p.topic))].map(option));
}

export function listTiers(app) {
  const tiers = [...new Set([...app.marks.tiers.keys(), ...Object.keys(app.vocabularies)])].sort();
  const key = tiers.join("\n");
  if (key !== listTiers.key) {
    listTiers.key = key;
    byId("lanes").replaceChildren(...tiers.filter((t) => app.marks.tiers.has(t)).map((tier) =>
      checkbox(runLast(tier), !app.hidden.has(tier), app.colorOf(tier), (shown) => {
        if (shown) app.hidden.delete(tier);
        else app.hidden.add(tier);
        app.stage.dirty = true;
      })));
    byId("tiers").replaceChildren(...tiers.map(option));
  }
  byId("labels").replaceChildren(...app.labelsOf(app.tier()).map(option));
}

// Of a tier like run/stance what tells it from the others of its run.
export const lastPart = (tier) => tier.slice(tier.lastIndexOf("/") + 1);

// The same in front of its run: the end of long names is cut.
const runLast = (tier) => (tier.includes("/") ? `${lastPart(tier)} · ${tier.slice(0, tier.lastIndexOf("/"))}` : tier);

const option = (value) => Object.assign(document.createElement("option"), { value });

export function listAnnotations(app) {
  const { view, marks, selected, hidden } = app;
  const { rows, count } = marks.seen(view.start, view.end, MOST, hidden);
  byId("count").textContent = count > MOST ? `(first ${MOST} of ${count})` : `(${count})`;
  byId("list").tBodies[0].replaceChildren(...rows.map((row) => {
    const line = document.createElement("tr");
    line.className = row.id === selected ? "on" : "";
    for (const text of [seconds(row.start_ns), seconds(row.end_ns - row.start_ns), lastPart(row.tier), row.label]) {
      line.append(Object.assign(document.createElement("td"), { textContent: text, title: text }));
    }
    const chip = Object.assign(document.createElement("span"), { className: "chip" });
    chip.style.background = app.colorOf(row.tier);
    line.children[2].title = row.tier;
    line.children[2].prepend(chip);
    line.addEventListener("click", () => { app.select(row.id); app.showSelected(false); });
    return line;
  }));
}

export function details(app) {
  const form = byId("details");
  const row = app.marks.rows.get(app.selected);
  form.hidden = !row;
  if (!row) return;
  const values = {
    label: row.label, tier: row.tier, note: row.note ?? "", channel: row.channel ?? "", confidence: row.confidence ?? "",
    start: exact(row.start_ns), end: exact(row.end_ns),
  };
  for (const [name, value] of Object.entries(values)) {
    if (document.activeElement !== form[name] || form.dataset.id !== row.id) form[name].value = value;
  }
  form.dataset.id = row.id;
  byId("source").textContent = `${row.source ?? "no source"} · id ${row.id}`;
}

// Seconds with all nanoseconds, so that a field that is left as it was changes nothing.
const exact = (t) => (t / SECOND).toFixed(9).replace(/0+$/, "").replace(/\.$/, "");

export function listenDetails(app) {
  const form = byId("details");
  const commit = (field) => {
    const id = form.dataset.id;
    const { name } = field;
    const value = field.value.trim();
    if (name === "start" || name === "end") {
      const t = Math.round(Number(value.replace(",", ".")) * SECOND);
      if (!value || !Number.isFinite(t)) return app.failed(new Error(`${name}: ${value || "nothing"} is not a number of seconds`));
      app.change(id, { [`${name}_ns`]: t });
    } else if (name === "confidence") {
      const share = value === "" ? null : Number(value.replace(",", "."));
      if (Number.isNaN(share)) return app.failed(new Error(`confidence: ${value} is not a number from 0 to 1`));
      app.change(id, { confidence: share });
    } else if (name === "label" || name === "tier") {
      app.change(id, { [name]: field.value });
    } else {
      app.change(id, { [name]: value || null });
    }
  };
  form.addEventListener("change", (event) => commit(event.target));
  form.addEventListener("keydown", (event) => {
    if (event.key !== "Enter") return;
    event.preventDefault();
    app.toStage(); // the field loses the focus, which commits it
  });
  form.addEventListener("submit", (event) => event.preventDefault());
}
