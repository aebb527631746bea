/* Figures as SVG, drawn for the width of their box, and saved as SVG or PNG. */
const SVG = "http://www.w3.org/2000/svg";
const NARROW = 430, ROW = 26, NARROW_ROW = 40, LEAST_PLOT = 140, TOP = 10, BOTTOM = 44;
const measure = document.createElement("canvas").getContext("2d");
const seriesColour = (number) => Number.isInteger(number) && number >= 0 ? `series-${number}` : "muted";

function textWidth(text, size = 13) {
  measure.font = `${size}px system-ui, sans-serif`;
  return measure.measureText(text).width;
}

function element(name, attributes = {}, text = "") {
  const out = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) out.setAttribute(key, value);
  if (text) out.textContent = text;
  return out;
}

function shortened(text, width) {
  if (textWidth(text) <= width) return text;
  let end = text.length;
  while (end > 1 && textWidth(text.slice(0, end) + "…") > width) end--;
  return text.slice(0, end) + "…";
}

/* A name with a number behind it: where both do not fit, the name is shortened. */
function labelled(name, tail, width) {
  return shortened(name, Math.max(40, width - textWidth(tail))) + tail;
}

/* Text as lines of at most a width. */
function wrapped(text, width) {
  const lines = [""];
  for (const word of text.split(" ")) {
    const longer = `${lines.at(-1)} ${word}`.trim();
    if (textWidth(longer) <= width || !lines.at(-1)) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}

/* The text of an axis; where it does not fit, without what the title states as well. */
function axisText(text, width) {
  const short = text.slice(text.indexOf(", ") + 2);
  return shortened(textWidth(text) <= width ? text : short, width);
}

/* Round numbers within a range. */
function ticks(low, high, count) {
  const raw = (high - low) / Math.max(1, count), power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= raw);
  const out = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) out.push(i * step);
  return { step, values: out };
}

function printed(value, decimals) {
  const text = value.toFixed(decimals);
  return Number(text) === 0 ? (0).toFixed(decimals) : text;
}

function tickText(value, step) {
  return printed(value, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
}

/* The range of an axis; controls far outside of the others are drawn as arrows at its edge. */
function rangeOf(spec, rows) {
  const numbers = (row) => [row.value, row.low, row.high].filter(Number.isFinite);
  const always = [...(spec.zero === null ? [] : [0]), ...(spec.rungs || []).map((r) => r.value)];
  const own = rows.filter((row) => !row.control).flatMap(numbers);
  const all = [...always, ...(own.length ? own : rows.flatMap(numbers))];
  let low = Math.min(...all), high = Math.max(...all);
  const extent = high - low || Math.abs(high) || 1;
  for (const row of rows.filter((each) => each.control)) {
    const inside = numbers(row).filter((v) => v > low - 1.5 * extent && v < high + 1.5 * extent);
    if (inside.includes(row.value)) {
      low = Math.min(low, ...inside);
      high = Math.max(high, ...inside);
    }
  }
  if (high - low < 1e-9) [low, high] = [low - (Math.abs(low) || 1) / 20, high + (Math.abs(high) || 1) / 20];
  const margin = 0.05 * (high - low);
  return [low - margin, high + margin];
}

function valueText(row, decimals, sign) {
  const text = printed(row.value, decimals);
  const head = sign && !text.startsWith("-") ? "+" + text : text;
  if (!Number.isFinite(row.low) || !Number.isFinite(row.high)) return head;
  return `${head} [${printed(row.low, decimals)}, ${printed(row.high, decimals)}]`;
}

/* A row for each method or tag: a value with its interval on a common axis. */
function drawRows(spec, width, chosen = 0) {
  const rows = spec.choices ? spec.choices[chosen].rows : spec.rows;
  const difference = spec.zero !== null;
  const texts = rows.map((row) => valueText(row, spec.decimals, difference));
  const narrow = width < NARROW;
  const right = narrow ? 12 : Math.max(...texts.map((text) => textWidth(text))) + 22;
  const most = Math.max(width * 0.34, Math.min(width / 2, width - right - LEAST_PLOT));
  const left = narrow ? 12 : Math.min(Math.max(...rows.map((r) => textWidth(r.label))) + 18, most);
  const rowHeight = narrow ? NARROW_ROW : ROW;
  const rungs = spec.rungs || [];
  const [low, high] = rangeOf(spec, rows);
  const x = (v) => left + (v - low) / (high - low) * (width - left - right);
  const placed = placeRungs(rungs, x), top = TOP + placed.height;
  const bottom = top + rows.length * rowHeight, height = bottom + BOTTOM;
  const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img" });
  svg.append(element("title", {}, spec.title));
  drawAxis(svg, spec, { low, high, x, top, bottom, left, right: width - right, width });
  drawRungs(svg, rungs, placed.labels, x, top, bottom);
  rows.forEach((row, i) => {
    const y = top + (i + 0.5) * rowHeight + (narrow ? 8 : 0);
    const group = element("g", { class: `row ${row.class}${row.control ? " control" : ""}` });
    const label = narrow ? labelled(row.label, `   ${texts[i]}`, width - 24) : row.label;
    const name = element("text", { class: "name", x: narrow ? left : left - 12, y: narrow ? y - 12 : y + 4,
      "text-anchor": narrow ? "start" : "end" }, shortened(label, narrow ? width - 24 : left - 14));
    group.append(element("title", {}, `${row.label}: ${texts[i]}`));
    if (difference && row.mde > 0 && !row.control) {
      const from = Math.max(x(-row.mde), left), to = Math.min(x(row.mde), width - right);
      if (to > from) group.append(element("rect", { class: "mde", x: from, y: y - 8, width: to - from, height: 16 }));
    }
    group.append(name);
    drawValue(group, row, { x, y, left, right: width - right });
    if (!narrow) {
      group.append(element("text", { class: "value", x: width - 6, y: y + 4, "text-anchor": "end" }, texts[i]));
    }
    svg.append(group);
  });
  return svg;
}

function drawValue(group, row, { x, y, left, right }) {
  const at = x(row.value);
  if (at < left || at > right) {
    const edge = at < left ? left : right, inward = at < left ? 9 : -9;
    group.append(element("path", { class: "mark", d: `M${edge} ${y}l${inward} -5v10z` }));
    return;
  }
  if (Number.isFinite(row.low) && Number.isFinite(row.high)) {
    const from = Math.max(x(row.low), left), to = Math.min(x(row.high), right);
    group.append(element("line", { class: "interval", x1: from, x2: to, y1: y, y2: y }));
  }
  group.append(row.control
    ? element("rect", { class: "mark", x: at - 4, y: y - 4, width: 8, height: 8 })
    : element("circle", { class: "mark", cx: at, cy: y, r: 5.5 }));
}

function drawAxis(svg, spec, { low, high, x, top, bottom, left, right, width }) {
  const { step, values } = ticks(low, high, Math.max(3, (right - left) / 80));
  for (const value of values) {
    const px = x(value);
    svg.append(element("line", { class: "grid", x1: px, x2: px, y1: top, y2: bottom }));
    svg.append(element("text", { class: "tick", x: px, y: bottom + 17, "text-anchor": "middle" }, tickText(value, step)));
  }
  if (spec.zero !== null && spec.zero !== undefined) {
    svg.append(element("line", { class: "zero", x1: x(0), x2: x(0), y1: top, y2: bottom }));
  }
  svg.append(element("text", { class: "axis", x: width < NARROW ? width / 2 : (left + right) / 2, y: bottom + 36, "text-anchor": "middle" },
    axisText(spec.axis, width - 16)));
}

/* Gives every rung a line of text on which it overlaps no other; rungs at nearly the same place share
   a label. Returns the labels and the height of all lines. */
function placeRungs(rungs, x) {
  const labels = [], ends = [];
  for (const rung of [...rungs].sort((a, b) => a.value - b.value)) {
    const px = x(rung.value), before = labels.at(-1);
    if (before && px - before.px < 8) before.rungs.push(rung);
    else labels.push({ px, rungs: [rung] });
  }
  for (const label of labels) {
    label.text = rungs.filter((rung) => label.rungs.includes(rung)).map((r) => r.label).join(", ");
    const half = textWidth(label.text, 12) / 2 + 5;
    const line = ends.findIndex((end) => end < label.px - half);
    label.line = line < 0 ? ends.length : line;
    ends[label.line] = label.px + half;
  }
  return { labels, height: labels.length ? 16 * ends.length + 16 : 0 };
}

/* The ladder as a scale: a bar from constant velocity to the oracle with a mark at every rung. */
function drawRungs(svg, rungs, labels, x, top, bottom) {
  if (!rungs.length) return;
  const y = top - 8, at = rungs.map((rung) => x(rung.value));
  svg.append(element("line", { class: "ladder", x1: Math.min(...at), x2: Math.max(...at), y1: y, y2: y }));
  for (const px of at) {
    svg.append(element("line", { class: "guide", x1: px, x2: px, y1: y, y2: bottom }));
    svg.append(element("line", { class: "ladder", x1: px, x2: px, y1: y - 4, y2: y + 4 }));
  }
  for (const { px, line } of labels) {
    svg.append(element("line", { class: "stem", x1: px, x2: px, y1: y - 6 - 16 * line, y2: y }));
  }
  for (const { px, text, line } of labels) {
    svg.append(element("text", { class: "rung", x: px, y: y - 9 - 16 * line, "text-anchor": "middle" }, text));
  }
}

/* Lines over time with whiskers. */
function drawLines(spec, width) {
  const left = 52, right = 14, points = spec.series.flatMap((series) => series.points);
  const legendRows = [[]];
  let used = left;
  for (const series of spec.series) {
    const need = textWidth(series.label) + 44;
    if (used + need > width - right && legendRows.at(-1).length) {
      legendRows.push([]);
      used = left;
    }
    legendRows.at(-1).push([series, used]);
    used += need;
  }
  const top = TOP + 20 * legendRows.length + 6, bottom = top + 230, height = bottom + BOTTOM;
  const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img" });
  svg.append(element("title", {}, spec.title));
  const high = Math.max(...points.flatMap(([, ...v]) => v.filter(Number.isFinite))) * 1.05 || 1;
  const last = Math.max(...points.map(([at]) => at)) * 1.03;
  const x = (v) => left + v / last * (width - left - right), y = (v) => bottom - v / high * (bottom - top);
  drawAxis(svg, { axis: spec.axis }, { low: 0, high: last, x, top, bottom, left, right: width - right, width });
  const scale = ticks(0, high, 5);
  for (const value of scale.values) {
    svg.append(element("line", { class: "grid", x1: left, x2: width - right, y1: y(value), y2: y(value) }));
    svg.append(element("text", { class: "tick", x: left - 8, y: y(value) + 4, "text-anchor": "end" }, tickText(value, scale.step)));
  }
  svg.append(element("text", { class: "axis", x: 4, y: top - 8 }, spec.vertical));
  for (const [line, entries] of legendRows.entries()) {
    for (const [series, px] of entries) {
      const py = TOP + 20 * line + 4, style = `stroke: var(--${seriesColour(series.colour)})`;
      svg.append(element("line", { class: "series", style, x1: px, x2: px + 20, y1: py, y2: py }));
      svg.append(element("text", { class: "name", x: px + 26, y: py + 4 }, series.label));
    }
  }
  for (const series of spec.series) {
    const paint = `var(--${seriesColour(series.colour)})`;
    const path = series.points.map(([at, v], i) => `${i ? "L" : "M"}${x(at)} ${y(v)}`).join("");
    svg.append(element("path", { class: "series", style: `stroke: ${paint}`, d: path }));
    for (const [at, value, lower, upper] of series.points) {
      const dot = element("circle", { class: "dot", style: `fill: ${paint}`, cx: x(at), cy: y(value), r: 4 });
      dot.append(element("title", {}, `${series.label}: ${valueText({ value, low: lower, high: upper }, 2, false)}`));
      if (Number.isFinite(lower) && Number.isFinite(upper)) {
        svg.append(element("line", { class: "whisker", style: `stroke: ${paint}`, x1: x(at), x2: x(at), y1: y(lower), y2: y(upper) }));
      }
      svg.append(dot);
    }
  }
  return svg;
}

/* A bar for each scenario; those with a rollout open it. */
function drawBars(spec, width, chosen = 0) {
  const { bars, text, label } = spec.choices[chosen];
  const lines = wrapped(text, width - 8);
  const left = 52, right = 14, top = TOP + 6 + 18 * lines.length, bottom = top + 180, height = bottom + 34;
  const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img" });
  svg.append(element("title", {}, spec.title));
  lines.forEach((line, i) => svg.append(element("text", { class: "name", x: 4, y: 16 + 18 * i }, line)));
  const values = bars.map(([value]) => value);
  const low = Math.min(0, ...values), high = Math.max(0, ...values), extent = high - low || 1;
  const y = (v) => bottom - (v - low) / extent * (bottom - top);
  const scale = ticks(low, low + extent, 4);
  for (const value of scale.values) {
    svg.append(element("line", { class: "grid", x1: left, x2: width - right, y1: y(value), y2: y(value) }));
    svg.append(element("text", { class: "tick", x: left - 8, y: y(value) + 4, "text-anchor": "end" }, tickText(value, scale.step)));
  }
  const step = Math.min(40, (width - left - right) / Math.max(1, bars.length));
  bars.forEach(([value, name], i) => {
    const saved = DATA.drives.some((drive) => drive.name === name);
    const bar = element("rect", { class: `bar ${value > 0 ? "better" : "worse"}${saved ? " saved" : ""}`,
      x: left + i * step, width: Math.max(1, step * 0.8), y: y(Math.max(value, 0)),
      height: Math.abs(y(value) - y(0)), "data-drive": name });
    bar.append(element("title", {}, `${name}: ${value > 0 ? "+" : ""}${value.toFixed(3)}${saved ? ", click to play" : ""}`));
    if (saved) bar.addEventListener("click", () => openFromBar(name, label));
    svg.append(bar);
  });
  svg.append(element("line", { class: "zero", x1: left, x2: width - right, y1: y(0), y2: y(0) }));
  svg.append(element("text", { class: "axis", x: (left + width - right) / 2, y: height - 10, "text-anchor": "middle" },
    shortened("scenarios in descending order; full bars have a rollout", width - 16)));
  return svg;
}

/* Points in metres as the text of a path, y down. */
function pathText(xy) {
  const out = [];
  for (let i = 0; i < xy.length; i += 2) {
    out.push(`${i ? "L" : "M"}${xy[i].toFixed(2)} ${(-xy[i + 1]).toFixed(2)}`);
  }
  return out.join("");
}

/* Where two methods part: their paths, the agents at that tick, and forecasts made there. */
function drawParting(spec, width) {
  const [left, bottom, metres, high] = spec.window, top = 20 * spec.methods.length + 16;
  const height = Math.min(Math.max(width * high / metres, 240), 440);
  const scale = Math.min(width / metres, height / high), whole = top + height;
  const svg = element("svg", { viewBox: `0 0 ${width} ${whole}`, width, height: whole, role: "img" });
  const colours = ["ego", "second"], paint = (name) => `var(--${name})`;
  svg.append(element("title", {}, spec.title));
  spec.methods.forEach(({ label, score }, i) => {
    const y = TOP + 20 * i + 4;
    svg.append(element("line", { class: "series", style: `stroke: ${paint(colours[i])}`, x1: 4, x2: 26, y1: y, y2: y }));
    svg.append(element("text", { class: "name", x: 32, y: y + 4 }, labelled(label, `: score ${score.toFixed(3)}`, width - 40)));
  });
  const clip = `picture-${pictures++}`, frame = { x: 0, y: top, width, height };
  const mask = element("clipPath", { id: clip });
  mask.append(element("rect", frame));
  const view = element("g", { "clip-path": `url(#${clip})` });
  const world = element("g", { transform: `translate(${width / 2} ${top + height / 2}) scale(${scale}) ` +
    `translate(${-(left + metres / 2)} ${bottom + high / 2})` });
  const line = (xy, className, px, colour = null) => {
    world.append(element("path", { class: className, d: pathText(xy), "stroke-width": px / scale,
      ...(colour && { style: `stroke: ${paint(colour)}` }) }));
  };
  drawGround(world, spec.map, line);
  spec.methods.forEach(({ forecasts }, i) => {
    for (const each of forecasts) line(points(each), "path forecast", 1.2, colours[i]);
  });
  spec.methods.forEach(({ path }, i) => {
    const xy = points(path);
    line(xy, "path", i ? 2.5 : 6, colours[i]);
    for (let n = spec.tick; n < xy.length / 2; n += spec.ticks_per_s) {
      world.append(element("circle", { class: "agent", style: `fill: ${paint(colours[i])}`,
        cx: xy[2 * n], cy: -xy[2 * n + 1], r: (i ? 3 : 4.5) / scale, "stroke-width": 1 / scale }));
    }
  });
  for (const [kind, length, breadth, x, y, heading] of spec.agents) {
    world.append(element("rect", { class: kind === -2 ? "agent second" : "agent", x: -length / 200, y: -breadth / 200, width: length / 100,
      height: breadth / 100, rx: 0.3, "stroke-width": 1.2 / scale,
      style: `fill: ${paint(kind < 0 ? colours[-1 - kind] : CLASSES[kind])}`,
      transform: `translate(${x / 100} ${-y / 100}) rotate(${-heading / 1000 * 180 / Math.PI})` }));
  }
  view.append(element("rect", { class: "ground", ...frame }), world);
  svg.append(mask, view);
  return svg;
}

let pictures = 0;

function drawGround(world, number, line) {
  const map = DATA.maps[number];
  world.append(element("path", { class: "road", d: map.drivable.map((ring) => `${pathText(points(ring))}Z`).join("") }));
  for (const [kind, each] of map.lines) {
    line(points(each), kind === CURB ? "curb" : kind === DASHED ? "marking dashed" : "marking", 1);
  }
}

const KINDS = { rows: drawRows, lines: drawLines, bars: drawBars, parting: drawParting };

/* Draws all figures, and again for another width, theme or choice. */
function showCharts() {
  for (const figure of document.querySelectorAll(".chart")) {
    const spec = DATA.figures[figure.dataset.key][Number(figure.dataset.number)];
    const plot = figure.querySelector(".plot");
    const choice = spec.choices && spec.choices.length > 1 ? choiceOf(figure, spec) : null;
    const draw = () => {
      const width = Math.floor(plot.clientWidth);
      if (width) plot.replaceChildren(KINDS[spec.kind](spec, width, choice ? choice.selectedIndex : 0));
    };
    choice?.addEventListener("change", draw);
    let before = 0;
    new ResizeObserver(() => {
      const width = Math.floor(plot.clientWidth);
      if (width !== before) draw();
      before = width;
    }).observe(plot);
    draw();
    if (spec.open) addPlay(figure, spec);
    for (const button of figure.querySelectorAll(".save")) {
      button.addEventListener("click", () => saveChart(figure, spec, button.dataset.format));
    }
  }
}

/* A button that shows the drives of a picture in the player, at its tick. */
function addPlay(figure, spec) {
  const button = document.createElement("button");
  button.className = "save open";
  button.textContent = "Play";
  button.setAttribute("aria-label", `Play: ${spec.title}`);
  button.addEventListener("click", () => window.player.open(spec.open).then(() => {
    window.player.remember();
    showPlayer();
  }));
  figure.querySelector("figcaption .grow").after(button);
}

function choiceOf(figure, spec) {
  const select = document.createElement("select");
  select.setAttribute("aria-label", `Method: ${spec.title}`);
  select.replaceChildren(...spec.choices.map((each, number) => new Option(each.label, number)));
  figure.querySelector("figcaption .grow").after(select);
  return select;
}

const KEPT = ["fill", "stroke", "stroke-width", "stroke-dasharray", "stroke-linecap", "stroke-linejoin",
  "opacity", "fill-opacity", "fill-rule", "paint-order", "font-family", "font-size", "font-weight"];

/* A figure as the text of an SVG file, in the light theme, with its title. */
function chartText(figure, spec) {
  const root = document.documentElement, theme = root.dataset.theme;
  root.dataset.theme = "light";
  const shown = figure.querySelector("svg"), copy = shown.cloneNode(true);
  const sources = [...shown.querySelectorAll("*")];
  [...copy.querySelectorAll("*")].forEach((node, i) => {
    const style = getComputedStyle(sources[i]);
    for (const name of KEPT) node.setAttribute(name, style.getPropertyValue(name));
    node.removeAttribute("style");
    node.removeAttribute("class");
  });
  if (theme) root.dataset.theme = theme; else delete root.dataset.theme;
  const width = Number(shown.getAttribute("width")), height = Number(shown.getAttribute("height"));
  const choice = figure.querySelector("select");
  const title = choice ? `${spec.title}: ${choice.selectedOptions[0].text}` : spec.title;
  copy.setAttribute("xmlns", SVG);
  copy.setAttribute("viewBox", `0 -28 ${width} ${height + 28}`);
  copy.setAttribute("height", height + 28);
  const back = element("rect", { x: 0, y: -28, width, height: height + 28, fill: "#ffffff" });
  const head = element("text", { x: 8, y: -9, fill: "#1b2330", "font-family": "system-ui, sans-serif",
    "font-size": "14px", "font-weight": 600 }, title);
  copy.prepend(back, head);
  return new XMLSerializer().serializeToString(copy);
}

async function saveChart(figure, spec, format) {
  const text = chartText(figure, spec), blob = new Blob([text], { type: "image/svg+xml" });
  const name = `${spec.title}.${format}`;
  if (format === "svg") {
    download(blob, name);
    return;
  }
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
  await image.decode();
  const canvas = document.createElement("canvas"), scale = 3;
  canvas.width = image.width * scale;
  canvas.height = image.height * scale;
  canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
  canvas.toBlob((picture) => download(picture, name));
}
