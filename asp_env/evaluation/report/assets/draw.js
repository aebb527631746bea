/* Colours of the theme; maps, boxes and paths on a canvas in metres, y up. */
const DATA = JSON.parse(document.getElementById("data").textContent);
const CLASSES = ["car", "heavy", "heavy", "heavy", "heavy", "other", "two-wheeler",
  "vulnerable", "vulnerable", "vulnerable", "other"];
const CURB = 0, DASHED = 2;

/* Colours of the style sheet depend on the theme, which is the system's unless one is chosen. */
const themeListeners = [];
const knownColours = new Map();
const onTheme = (listener) => themeListeners.push(listener);

function colour(name) {
  if (!knownColours.has(name)) {
    const probe = document.createElement("i");
    probe.style.color = `var(--${name})`;
    document.body.append(probe);
    knownColours.set(name, getComputedStyle(probe).color);
    probe.remove();
  }
  return knownColours.get(name);
}

function setTheme(theme) {
  const root = document.documentElement;
  if (theme === "auto") delete root.dataset.theme; else root.dataset.theme = theme;
  knownColours.clear();
  for (const listener of themeListeners) listener();
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  knownColours.clear();
  for (const listener of themeListeners) listener();
});

function download(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name.replace(/[^\w.-]+/g, "-");
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/* Points in metres from steps in centimetres, of which the first is a position. */
function points(steps) {
  const out = new Float32Array(steps.length);
  let x = 0, y = 0;
  for (let i = 0; i < steps.length; i += 2) {
    x += steps[i];
    y += steps[i + 1];
    out[i] = x / 100;
    out[i + 1] = y / 100;
  }
  return out;
}

function trace(path, xy, from = 0) {
  for (let i = from; i < xy.length; i += 2) {
    if (i === from) path.moveTo(xy[i], xy[i + 1]); else path.lineTo(xy[i], xy[i + 1]);
  }
}

function preparedMap(number) {
  const map = DATA.maps[number];
  if (!map.paths) {
    const road = new Path2D();
    for (const ring of map.drivable) {
      trace(road, points(ring));
      road.closePath();
    }
    const curbs = new Path2D(), solid = new Path2D(), dashed = new Path2D();
    for (const [kind, line] of map.lines) {
      trace(kind === CURB ? curbs : kind === DASHED ? dashed : solid, points(line));
    }
    map.paths = { road, curbs, solid, dashed };
  }
  return map.paths;
}

/* Adapts a canvas to its box and the screen; returns its size in CSS pixels. */
function fit(canvas) {
  const ratio = devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  const w = Math.round(width * ratio), h = Math.round(height * ratio);
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
  }
  return { width, height, ratio };
}

/* A drawing context in metres with `scale` CSS pixels per metre and (x, y) in the middle. */
function begin(canvas, x, y, scale) {
  const { width, height, ratio } = fit(canvas);
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.fillStyle = colour("ground");
  ctx.fillRect(0, 0, width, height);
  ctx.translate(width / 2, height / 2);
  ctx.scale(scale, -scale);
  ctx.translate(-x, -y);
  ctx.lineJoin = ctx.lineCap = "round";
  return ctx;
}

function drawMap(ctx, number, scale) {
  const paths = preparedMap(number);
  ctx.fillStyle = ctx.strokeStyle = colour("road");
  ctx.lineWidth = 0.15;
  ctx.fill(paths.road, "nonzero");
  ctx.stroke(paths.road);
  ctx.lineWidth = Math.max(0.16, 1 / scale);
  ctx.strokeStyle = colour("marking");
  ctx.stroke(paths.solid);
  ctx.setLineDash([1.6, 1.6]);
  ctx.lineCap = "butt";
  ctx.stroke(paths.dashed);
  ctx.setLineDash([]);
  ctx.lineCap = "round";
  ctx.strokeStyle = colour("curb");
  ctx.stroke(paths.curbs);
}

/* A box with a wedge at its front. */
function drawBox(ctx, [x, y, heading], [length, width], fill, edge, scale) {
  const l = length / 2, w = width / 2;
  ctx.save();
  ctx.translate(x, y);
  ctx.rotate(heading);
  ctx.beginPath();
  ctx.roundRect(-l, -w, 2 * l, 2 * w, Math.min(0.35, w / 2));
  ctx.fillStyle = fill;
  ctx.fill();
  ctx.lineWidth = 1.2 / scale;
  ctx.strokeStyle = edge;
  ctx.stroke();
  ctx.beginPath();
  ctx.moveTo(l * 0.82, 0);
  ctx.lineTo(l * 0.82 - Math.min(1.1, l * 0.6), w * 0.62);
  ctx.lineTo(l * 0.82 - Math.min(1.1, l * 0.6), -w * 0.62);
  ctx.closePath();
  ctx.fillStyle = edge;
  ctx.globalAlpha *= 0.85;
  ctx.fill();
  ctx.restore();
}

function drawGhost(ctx, [x, y, heading], [length, width], scale) {
  ctx.save();
  ctx.translate(x, y);
  ctx.rotate(heading);
  ctx.strokeStyle = colour("ghost");
  ctx.lineWidth = 1.6 / scale;
  ctx.setLineDash([5 / scale, 3.5 / scale]);
  ctx.strokeRect(-length / 2, -width / 2, length, width);
  ctx.restore();
}

function drawPath(ctx, xy, stroke, widthPx, alpha, scale, dash) {
  const path = new Path2D();
  trace(path, xy);
  ctx.save();
  ctx.globalAlpha = alpha;
  ctx.strokeStyle = stroke;
  ctx.lineWidth = widthPx / scale;
  if (dash) ctx.setLineDash(dash.map((d) => d / scale));
  ctx.stroke(path);
  ctx.restore();
}

function drawDot(ctx, x, y, fill, radiusPx, alpha, scale) {
  ctx.save();
  ctx.globalAlpha = alpha;
  ctx.fillStyle = fill;
  ctx.beginPath();
  ctx.arc(x, y, radiusPx / scale, 0, 2 * Math.PI);
  ctx.fill();
  ctx.restore();
}

/* Modes, the least probable first; width and opacity show the probability. */
function drawModes(ctx, modes, start, stroke, scale) {
  for (const [p, steps] of [...modes].sort((a, b) => a[0] - b[0])) {
    const xy = points(steps);
    const whole = new Float32Array(xy.length + 2);
    whole.set(start);
    whole.set(xy, 2);
    const alpha = 0.25 + 0.7 * p;
    drawPath(ctx, whole, stroke, 1.2 + 3.6 * p, alpha, scale);
    drawDot(ctx, xy[xy.length - 2], xy[xy.length - 1], stroke, 2 + 2.4 * p, alpha, scale);
  }
}

/* A scale bar in the lower left corner, in CSS pixels. */
function drawScale(ctx, canvas, scale) {
  const { height, ratio } = fit(canvas);
  const metres = [1, 2, 5, 10, 20, 50, 100, 200].find((m) => m * scale > 50) || 500;
  ctx.save();
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.strokeStyle = ctx.fillStyle = colour("muted");
  ctx.lineWidth = 1.5;
  ctx.beginPath();
  ctx.moveTo(12, height - 18);
  ctx.lineTo(12, height - 12);
  ctx.lineTo(12 + metres * scale, height - 12);
  ctx.lineTo(12 + metres * scale, height - 18);
  ctx.stroke();
  ctx.font = "11px system-ui, sans-serif";
  ctx.fillText(metres + " m", 18, height - 17);
  ctx.restore();
}

function legend(element, entries) {
  for (const [name, label, kind] of entries) {
    const item = document.createElement("span"), mark = document.createElement("i");
    mark.className = kind || "";
    const value = name.startsWith("#") ? name : `var(--${name})`;
    mark.style[kind ? "borderColor" : "background"] = value;
    item.append(mark, label);
    element.append(item);
  }
}
