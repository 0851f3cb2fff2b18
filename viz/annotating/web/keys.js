// Everything by keyboard. A key works on the stage and anywhere else where no text is typed; those with Ctrl work
// in fields too.

export const KEYS = [
  ["← →", "cursor by a pixel; with Shift by ten; with Alt by one sample", ["ArrowLeft", "ArrowRight"]],
  ["↑ ↓ or + −", "zoom in and out about the cursor", ["ArrowUp", "ArrowDown", "+", "=", "-"]],
  ["Page Up, Page Down", "one screen back, forth", ["PageUp", "PageDown"]],
  ["Home, End", "cursor to the start, end of the recording", ["Home", "End"]],
  ["0", "show the whole recording", ["0"]],
  ["f", "show the selected annotation", ["f"]],
  ["m", "begin a stretch at the cursor; again: end it (Esc: leave it)", ["m"]],
  ["i", "mark an instant at the cursor", ["i"]],
  ["n, p", "select the next, the previous annotation", ["n", "p"]],
  ["s, e", "move the start, the end of the selected one to the cursor", ["s", "e"]],
  ["g", "move the selected one to the cursor", ["g"]],
  ["1 … 9", "give it (or the next mark) a label of its tier, in the order of the list", ["1", "2", "3", "4", "5", "6", "7", "8", "9"]],
  ["Enter", "edit the selected one; Enter again: back to the signals", ["Enter"]],
  ["l, t", "type the label, the tier of the next marks", ["l", "t"]],
  ["Delete", "remove the selected one", ["Delete", "Backspace"]],
  ["Ctrl+C, Ctrl+V", "copy; paste at the cursor", []],
  ["Ctrl+Z, Ctrl+Y", "undo; redo (Ctrl+Shift+Z too)", []],
  ["Ctrl+S", "save", []],
  ["y", "fit heights to what is seen", ["y"]],
  ["Space", "play or stop the film", [" "]],
  ["Tab", "on to signals, buttons, channels, fields", []],
  ["?", "these keys", ["?"]],
];

const typed = (element) => element?.matches?.("input:not([type=checkbox]), textarea, select");

export function listen(app) {
  document.addEventListener("keydown", (event) => {
    if (document.querySelector("dialog[open]")) return;
    const { target } = event;
    const command = event.ctrlKey || event.metaKey;
    if (command) {
      const key = event.key.toLowerCase();
      const done = {
        z: () => (event.shiftKey ? app.redo() : app.undo()),
        y: () => app.redo(),
        s: () => app.save(),
        c: () => !typed(target) && app.copy(),
        v: () => !typed(target) && app.paste(),
      }[key];
      if (done && !(typed(target) && "cv".includes(key))) {
        event.preventDefault();
        done();
      }
      return;
    }
    if (typed(target)) {
      if (event.key === "Escape" || (event.key === "Enter" && !target.form)) app.toStage();
      return;
    }
    const button = target.matches?.("button, input, video");
    if (button && [" ", "Enter"].includes(event.key)) return; // it presses what has the focus
    if (act(app, event)) event.preventDefault();
  });
}

function act(app, event) {
  const { view, cursor } = app;
  const { key } = event;
  const pixels = event.shiftKey ? 10 : 1;
  const step = event.altKey ? app.sample() : pixels * view.perPixel;
  switch (key) {
    case "ArrowLeft": app.setCursor(cursor - step); break;
    case "ArrowRight": app.setCursor(cursor + step); break;
    case "ArrowUp": case "+": case "=": app.zoom(0.7); break;
    case "ArrowDown": case "-": app.zoom(1 / 0.7); break;
    case "PageUp": app.page(-1); break;
    case "PageDown": app.page(1); break;
    case "Home": app.setCursor(view.first); break;
    case "End": app.setCursor(view.last); break;
    case "0": app.whole(); break;
    case "f": app.showSelected(); break;
    case "m": app.beginOrEnd(); break;
    case "i": app.mark(cursor, cursor); break;
    case "n": app.step(1); break;
    case "p": app.step(-1); break;
    case "s": app.edge("start"); break;
    case "e": app.edge("end"); break;
    case "g": app.move(); break;
    case "Enter": app.focusDetails("label"); break;
    case "l": app.focusField("label"); break;
    case "t": app.focusField("tier"); break;
    case "Delete": case "Backspace": app.remove(); break;
    case "Escape": app.leave(); break;
    case "y": app.setFit(!app.fit); break;
    case " ": app.film.toggle(); break;
    case "?": app.help(); break;
    default:
      if (!/^[1-9]$/.test(key)) return false;
      app.number(Number(key) - 1);
  }
  return true;
}
