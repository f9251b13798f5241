// Readings on their ellipsoid (left) and on the sphere (right): drag to turn, wheel or pinch to zoom, arrow keys.
// Everything is drawn on two plain canvases; the turntable keeps z upright, and both sides turn together.
"use strict";

function margcalViewer(place, data) {
  const kinds = Object.keys(data);
  const state = { kind: kinds[0], azimuth: -0.9, elevation: 0.42, zoom: 1, stretch: 1, hover: null };
  const START = { azimuth: state.azimuth, elevation: state.elevation, zoom: 1 };

  // --- page elements ---------------------------------------------------------------------------------

  function element(tag, attributes, parent, text) {
    const node = document.createElement(tag);
    for (const key of Object.keys(attributes || {})) node.setAttribute(key, attributes[key]);
    if (text !== undefined) node.textContent = text;
    if (parent) parent.appendChild(node);
    return node;
  }

  const bar = element("div", { class: "viewer-bar" }, place);
  const tabs = element("div", { class: "group", role: "group", "aria-label": "Sensor" }, bar);
  const tabButtons = kinds.map(function (kind) {
    const button = element("button", { type: "button" }, tabs, data[kind].name.replace(/^./, function (c) { return c.toUpperCase(); }));
    button.addEventListener("click", function () { state.kind = kind; state.hover = null; prepare(); refresh(); });
    return button;
  });
  const stretchGroup = element("div", { class: "group", role: "group", "aria-label": "Deviation from the sphere drawn larger" }, bar);
  element("span", { class: "label" }, stretchGroup, "deviation drawn");
  const stretchButtons = [1, 10, 100].map(function (factor) {
    const button = element("button", { type: "button" }, stretchGroup, "×" + factor);
    button.addEventListener("click", function () { state.stretch = factor; refresh(); });
    return button;
  });
  const reset = element("button", { type: "button", class: "plain" }, bar, "reset view");
  reset.addEventListener("click", function () { Object.assign(state, START); refresh(); });

  const panels = element("div", { class: "viewer-panels" }, place);
  const sides = [true, false].map(function (raw) {
    const box = element("div", { class: "viewer-panel" }, panels);
    const head = element("p", { class: "viewer-head" }, box);
    const canvas = element("canvas", { tabindex: "0", role: "img", class: raw ? "raw" : "cal" }, box);
    return { raw: raw, box: box, head: head, canvas: canvas, size: [0, 0], picks: [] };
  });
  const hint = element("p", { class: "viewer-hint", "aria-live": "polite" }, place);
  const HINT = "Drag to turn. Click a picture, then use the wheel to zoom; two fingers or + and − do as well.";
  hint.textContent = HINT;
  place.hidden = false;

  // --- geometry --------------------------------------------------------------------------------------

  function times(M, v) {
    return [
      M[0][0] * v[0] + M[0][1] * v[1] + M[0][2] * v[2],
      M[1][0] * v[0] + M[1][1] * v[1] + M[1][2] * v[2],
      M[2][0] * v[0] + M[2][1] * v[1] + M[2][2] * v[2],
    ];
  }

  function inverse(m) {
    const c = function (a, b, d, e) { return m[a][b] * m[d][e] - m[a][e] * m[d][b]; };
    const C = [
      [c(1, 1, 2, 2), -c(0, 1, 2, 2), c(0, 1, 1, 2)],
      [-c(1, 0, 2, 2), c(0, 0, 2, 2), -c(0, 0, 1, 2)],
      [c(1, 0, 2, 1), -c(0, 0, 2, 1), c(0, 0, 1, 1)],
    ];
    const det = m[0][0] * C[0][0] + m[0][1] * C[1][0] + m[0][2] * C[2][0];
    return C.map(function (row) { return row.map(function (v) { return v / det; }); });
  }

  const norm = function (v) { return Math.hypot(v[0], v[1], v[2]); };

  const WIRES = (function () {
    const lines = [];
    const N = 72;
    const at = function (f) { return Array.from({ length: N + 1 }, function (_, i) { return f((2 * Math.PI * i) / N); }); };
    for (let k = 0; k < 6; k++) {
      const a = (Math.PI * k) / 6;
      lines.push(at(function (s) { return [Math.cos(a) * Math.sin(s), Math.sin(a) * Math.sin(s), Math.cos(s)]; }));
    }
    for (let k = 1; k < 6; k++) {
      const b = (Math.PI * k) / 6;
      lines.push(at(function (s) { return [Math.sin(b) * Math.cos(s), Math.sin(b) * Math.sin(s), Math.cos(b)]; }));
    }
    return lines;
  })();

  let scene = null;

  // Unit vectors u/|u| and lengths of every reading, and the map from unit vectors to the picture of raw readings.
  function prepare() {
    const one = data[state.kind];
    const back = inverse(one.H).map(function (row) { return row.map(function (v) { return (v * one.magnitude) / one.radius; }); });
    const centre = one.centred ? [0, 0, 0] : one.B.map(function (b) { return b / one.radius; });
    const calibrated = function (y) {
      return times(one.H, [y[0] - one.B[0], y[1] - one.B[1], y[2] - one.B[2]]).map(function (v) { return v / one.magnitude; });
    };
    const offset = norm(centre);
    scene = {
      one: one,
      rests: one.rests.map(calibrated),
      samples: one.samples.map(calibrated),
      toRaw: function (p) { const q = times(back, p); return [q[0] + centre[0], q[1] + centre[1], q[2] + centre[2]]; },
      reach: 1.12 + 0.75 * offset,
    };
    const raw = "As read: the fitted ellipsoid" + (one.centred
      ? ", centred; the raw zero is outside the picture"
      : "; axes cross at the raw zero, the circle is what an ideal sensor would read");
    sides[0].head.textContent = raw;
    sides[1].head.textContent = "Calibrated: the unit sphere";
    sides[0].canvas.setAttribute("aria-label", one.name + " readings as read, on the fitted ellipsoid. Arrow keys turn the view.");
    sides[1].canvas.setAttribute("aria-label", one.name + " readings after calibration, on the unit sphere. Arrow keys turn the view.");
  }

  function stretched(p) {
    const r = norm(p);
    const f = (1 + state.stretch * (r - 1)) / r;
    return [p[0] * f, p[1] * f, p[2] * f];
  }

  function camera() {
    const ca = Math.cos(state.azimuth), sa = Math.sin(state.azimuth);
    const ce = Math.cos(state.elevation), se = Math.sin(state.elevation);
    return [[-sa, ca, 0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]];
  }

  // --- drawing ---------------------------------------------------------------------------------------

  function colours() {
    const style = getComputedStyle(document.documentElement);
    const get = function (name) { return style.getPropertyValue("--" + name).trim(); };
    return {
      ink: get("ink"), muted: get("muted"), wire: get("wire"), paper: get("panel"), raw: get("raw"), cal: get("cal"),
      axes: [get("axis-x"), get("axis-y"), get("axis-z")],
    };
  }

  function fit(side) {
    const ratio = window.devicePixelRatio || 1;
    const w = side.canvas.clientWidth, h = side.canvas.clientHeight;
    if (side.canvas.width !== Math.round(w * ratio) || side.canvas.height !== Math.round(h * ratio)) {
      side.canvas.width = Math.round(w * ratio);
      side.canvas.height = Math.round(h * ratio);
    }
    side.size = [w, h];
    const context = side.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, w, h);
    return context;
  }

  function draw(side) {
    const g = fit(side);
    const colour = colours();
    const view = camera();
    const w = side.size[0], h = side.size[1];
    const scale = (0.43 * Math.min(w, h) * state.zoom) / (side.raw ? scene.reach : 1.12);
    const place3 = side.raw ? scene.toRaw : function (p) { return p; };
    const project = function (p) {
      const q = times(view, p);
      return [w / 2 + scale * q[0], h / 2 - scale * q[1], q[2]];
    };
    const centre = project(place3([0, 0, 0]));
    g.lineCap = "round";
    if (side.raw && !scene.one.centred) ideal(g, colour, project([0, 0, 0]), scale);
    wires(g, colour, place3, project, centre[2], false);
    const dots = scene.samples.map(function (p) { return project(place3(p)); });
    const rests = scene.rests.map(function (p, i) {
      const direction = norm(p);
      return { i: i, p: project(place3(stretched(p))), foot: project(place3([p[0] / direction, p[1] / direction, p[2] / direction])) };
    });
    const tint = side.raw ? colour.raw : colour.cal;
    if (state.stretch === 1) points(g, dots, centre[2], tint, false);
    marks(g, rests, centre[2], tint, colour, false);
    axes(g, colour, project, side.raw && !scene.one.centred ? [0, 0, 0] : (side.raw ? place3([0, 0, 0]) : [0, 0, 0]));
    wires(g, colour, place3, project, centre[2], true);
    if (state.stretch === 1) points(g, dots, centre[2], tint, true);
    marks(g, rests, centre[2], tint, colour, true);
    side.picks = rests;
    if (state.hover !== null && rests[state.hover]) label(g, colour, rests[state.hover], w);
    side.canvas.dataset.points = String(dots.length + rests.length);
  }

  function ideal(g, colour, at, scale) {
    g.save();
    g.strokeStyle = colour.muted;
    g.globalAlpha = 0.55;
    g.setLineDash([3, 4]);
    g.lineWidth = 1;
    g.beginPath();
    g.arc(at[0], at[1], scale, 0, 2 * Math.PI);
    g.stroke();
    g.restore();
  }

  function wires(g, colour, place3, project, depth, front) {
    g.save();
    g.strokeStyle = colour.wire;
    g.globalAlpha = front ? 0.85 : 0.35;
    g.lineWidth = 1;
    g.beginPath();
    for (const line of WIRES) {
      let open = false;
      for (const p of line) {
        const q = project(place3(p));
        if ((q[2] >= depth) === front) {
          if (open) g.lineTo(q[0], q[1]); else g.moveTo(q[0], q[1]);
          open = true;
        } else {
          open = false;
        }
      }
    }
    g.stroke();
    g.restore();
  }

  function axes(g, colour, project, from) {
    g.save();
    g.font = "600 11px system-ui, sans-serif";
    g.textAlign = "center";
    g.textBaseline = "middle";
    const o = project(from);
    for (let k = 0; k < 3; k++) {
      const tip = from.slice(), name = from.slice();
      tip[k] += 0.5;
      name[k] += 0.6;
      const a = project(tip), b = project(name);
      g.strokeStyle = g.fillStyle = colour.axes[k];
      g.lineWidth = 1.6;
      g.beginPath();
      g.moveTo(o[0], o[1]);
      g.lineTo(a[0], a[1]);
      g.stroke();
      g.fillText("xyz"[k], b[0], b[1]);
    }
    g.restore();
  }

  function points(g, dots, depth, tint, front) {
    g.save();
    g.fillStyle = tint;
    g.globalAlpha = front ? 0.6 : 0.25;
    for (const p of dots) {
      if ((p[2] >= depth) === front) g.fillRect(p[0] - 0.9, p[1] - 0.9, 1.8, 1.8);
    }
    g.restore();
  }

  function marks(g, rests, depth, tint, colour, front) {
    g.save();
    for (const rest of rests) {
      if ((rest.p[2] >= depth) !== front) continue;
      g.globalAlpha = front ? 1 : 0.4;
      if (state.stretch > 1) {
        g.strokeStyle = tint;
        g.lineWidth = 1.4;
        g.beginPath();
        g.moveTo(rest.foot[0], rest.foot[1]);
        g.lineTo(rest.p[0], rest.p[1]);
        g.stroke();
      }
      g.beginPath();
      g.arc(rest.p[0], rest.p[1], rest.i === state.hover ? 6 : 4, 0, 2 * Math.PI);
      g.fillStyle = tint;
      g.strokeStyle = colour.paper;
      g.lineWidth = 1.5;
      g.fill();
      g.stroke();
    }
    g.restore();
  }

  function label(g, colour, rest, w) {
    const text = "rest " + scene.one.numbers[rest.i];
    g.save();
    g.font = "600 12px system-ui, sans-serif";
    const width = g.measureText(text).width + 12;
    const x = Math.min(Math.max(rest.p[0] + 10, 2), w - width - 2), y = Math.max(rest.p[1] - 28, 2);
    g.fillStyle = colour.ink;
    g.fillRect(x, y, width, 20);
    g.fillStyle = colour.paper;
    g.textBaseline = "middle";
    g.fillText(text, x + 6, y + 10.5);
    g.restore();
  }

  let asked = false;
  function refresh() {
    tabButtons.forEach(function (b, i) { b.setAttribute("aria-pressed", String(kinds[i] === state.kind)); });
    stretchButtons.forEach(function (b, i) { b.setAttribute("aria-pressed", String([1, 10, 100][i] === state.stretch)); });
    tell();
    if (asked) return;
    asked = true;
    requestAnimationFrame(function () { asked = false; sides.forEach(draw); });
  }

  function tell() {
    if (state.hover === null || !scene.rests[state.hover]) { hint.textContent = HINT; return; }
    const one = scene.one, r = norm(scene.rests[state.hover]) * one.magnitude;
    hint.textContent = "Rest " + one.numbers[state.hover] + ": magnitude " + r.toPrecision(6) + " " + one.unit +
      ", off by " + (100 * (r / one.magnitude - 1)).toFixed(3) + " %";
  }

  // --- hands -----------------------------------------------------------------------------------------

  function turn(dx, dy) {
    state.azimuth -= dx;
    state.elevation = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, state.elevation + dy));
    refresh();
  }

  function zoom(factor) {
    state.zoom = Math.min(12, Math.max(0.4, state.zoom * factor));
    refresh();
  }

  function nearest(side, x, y) {
    let best = null, least = 12;
    for (const rest of side.picks) {
      const d = Math.hypot(rest.p[0] - x, rest.p[1] - y) - (rest.p[2] > 0 ? 1 : 0);
      if (d < least) { least = d; best = rest.i; }
    }
    return best;
  }

  for (const side of sides) {
    const canvas = side.canvas;
    const down = new Map();
    canvas.addEventListener("pointerdown", function (event) {
      down.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
    });
    canvas.addEventListener("pointermove", function (event) {
      const last = down.get(event.pointerId);
      if (!last) {
        const box = canvas.getBoundingClientRect();
        const found = nearest(side, event.clientX - box.left, event.clientY - box.top);
        if (found !== state.hover) { state.hover = found; refresh(); }
        return;
      }
      const now = [event.clientX, event.clientY];
      if (down.size === 1) {
        turn((now[0] - last[0]) * 0.009, (now[1] - last[1]) * 0.009);
      } else if (down.size === 2) {
        const other = Array.from(down.entries()).find(function (e) { return e[0] !== event.pointerId; })[1];
        const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
        const after = Math.hypot(now[0] - other[0], now[1] - other[1]);
        if (before > 0) zoom(after / before);
      }
      down.set(event.pointerId, now);
    });
    const up = function (event) { down.delete(event.pointerId); };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("pointerleave", function () { if (state.hover !== null) { state.hover = null; refresh(); } });
    canvas.addEventListener("dblclick", function () { Object.assign(state, START); refresh(); });
    canvas.addEventListener("wheel", function (event) {
      // the page scrolls past the picture unless the picture has been chosen
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      zoom(Math.exp(-event.deltaY * 0.0015));
    }, { passive: false });
    canvas.addEventListener("keydown", function (event) {
      const step = 0.12;
      const act = {
        ArrowLeft: function () { turn(-step, 0); }, ArrowRight: function () { turn(step, 0); },
        ArrowUp: function () { turn(0, -step); }, ArrowDown: function () { turn(0, step); },
        "+": function () { zoom(1.15); }, "=": function () { zoom(1.15); }, "-": function () { zoom(1 / 1.15); },
        0: function () { Object.assign(state, START); refresh(); },
      }[event.key];
      if (act && !event.ctrlKey && !event.metaKey && !event.altKey) { event.preventDefault(); act(); }
    });
  }

  if (window.ResizeObserver) new ResizeObserver(refresh).observe(panels);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", refresh);
  const forPaper = function (on) {
    document.documentElement.classList.toggle("paper", on);
    sides.forEach(draw);
  };
  window.addEventListener("beforeprint", function () { forPaper(true); });
  window.addEventListener("afterprint", function () { forPaper(false); });

  prepare();
  refresh();
}
