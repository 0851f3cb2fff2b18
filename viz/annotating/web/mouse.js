// Mouse and pen: mark by dragging, move edges, pan, zoom.

const SLIP = 3; // pixels: less is a click

export function listen(stage, app) {
  const { element } = stage;
  const place = (event) => {
    const box = element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };

  element.addEventListener("pointerdown", (event) => {
    const [x, y] = place(event);
    const hit = stage.under(x, y);
    element.setPointerCapture(event.pointerId);
    element.focus();
    const base = { x, t: hit.t, start: app.view.start, moved: false };
    if (hit.part === "strip") app.drag = { ...base, kind: "strip" };
    else if (event.button === 1 || event.shiftKey || hit.part === "axis" || hit.part === "scale") app.drag = { ...base, kind: "pan" };
    else if (event.button !== 0) return;
    else if (hit.id) {
      app.select(hit.id);
      app.drag = { ...base, kind: "change", grip: hit.grip, before: app.marks.rows.get(hit.id) };
    } else app.drag = { ...base, kind: "mark", part: hit.part };
    if (app.drag.kind === "strip") move(event);
    event.preventDefault();
  });

  const move = (event) => {
    const [x, y] = place(event);
    const { drag, view } = app;
    if (!drag) {
      const hit = stage.under(x, y);
      element.style.cursor = hit.grip === "start" || hit.grip === "end" ? "ew-resize"
        : hit.grip ? "grab" : hit.part === "signals" ? "crosshair" : "default";
      app.hover(hit.t);
      return;
    }
    drag.moved ||= Math.abs(x - drag.x) >= SLIP;
    if (drag.kind === "strip") {
      view.pan(stage.stripTime(x) - (view.start + view.span / 2));
      stage.dirty = true;
    } else if (!drag.moved) {
      return;
    } else if (drag.kind === "pan") {
      view.start = view.start + (drag.x - x) * view.perPixel;
      view.end = view.start + view.perPixel * view.width;
      view.pan(0);
      drag.x = x;
      stage.dirty = true;
    } else if (drag.kind === "mark") {
      drag.from = view.inside(drag.t);
      drag.to = view.inside(view.at(x - stage.constructor.LEFT));
      app.hover(drag.to);
    } else {
      drag.row = changed(drag, view.at(x - stage.constructor.LEFT), view);
      app.hover(drag.grip === "end" ? drag.row.end_ns : drag.row.start_ns);
    }
    stage.frontDirty = true;
  };
  element.addEventListener("pointermove", move);

  element.addEventListener("pointerup", (event) => {
    const { drag } = app;
    app.drag = null;
    stage.frontDirty = true;
    if (!drag) return;
    if (drag.kind === "mark" && drag.from !== undefined) app.mark(Math.min(drag.from, drag.to), Math.max(drag.from, drag.to));
    else if (drag.kind === "change" && drag.row) app.change(drag.before.id, { start_ns: drag.row.start_ns, end_ns: drag.row.end_ns });
    else if (!drag.moved && drag.kind !== "strip" && event.button === 0) {
      app.setCursor(app.view.inside(drag.t));
      if (drag.kind === "mark" && drag.part === "lanes") app.select(null);
    }
  });
  element.addEventListener("pointercancel", () => { app.drag = null; stage.frontDirty = true; });

  element.addEventListener("dblclick", (event) => {
    const hit = stage.under(...place(event));
    if (hit.id && hit.part === "lanes") app.focusDetails("label");
    else if (hit.part === "signals" && !event.shiftKey) app.mark(app.view.inside(hit.t), app.view.inside(hit.t));
  });

  element.addEventListener("wheel", (event) => {
    const [x] = place(event);
    const { view } = app;
    const size = event.deltaMode === 1 ? 30 : 1;
    const across = event.shiftKey ? event.deltaY || event.deltaX : event.deltaX;
    if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) view.pan(across * size * view.perPixel);
    else view.zoom(1.0015 ** (event.deltaY * size), view.at(Math.max(x - stage.constructor.LEFT, 0)));
    stage.dirty = true;
    event.preventDefault();
  }, { passive: false });
}

// The annotation as it is while one of its edges, or all of it, is dragged to t.
function changed({ before, grip, t: grabbed }, t, view) {
  let { start_ns: start, end_ns: end } = before;
  if (grip === "all") {
    const by = Math.min(Math.max(t - grabbed, view.first - start), view.last - end);
    start = Math.round(start + by);
    end = start + (before.end_ns - before.start_ns);
  } else {
    const edge = view.inside(t);
    const other = grip === "start" ? end : start;
    [start, end] = [Math.min(edge, other), Math.max(edge, other)];
  }
  return { ...before, start_ns: start, end_ns: end };
}
