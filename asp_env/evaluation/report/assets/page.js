/* Tabs, plots in the colours of the page, and initialisation. */
function listenToTabs() {
  for (const tabs of document.querySelectorAll(".tabs")) {
    const buttons = [...tabs.querySelectorAll("[role=tab]")];
    const panels = [...tabs.querySelectorAll("[role=tabpanel]")];
    buttons.forEach((button, selected) => button.addEventListener("click", () => {
      buttons.forEach((other, n) => other.setAttribute("aria-selected", String(n === selected)));
      panels.forEach((panel, n) => { panel.hidden = n !== selected; });
    }));
  }
}

function themed(layout) {
  const text = colour("text").trim(), grid = colour("grid").trim();
  const out = { ...layout, font: { color: text, size: 13,
    family: "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif" } };
  for (const key of Object.keys(layout).filter((name) => /^[xy]axis/.test(name))) {
    out[key] = { ...layout[key], gridcolor: grid, zerolinecolor: grid, linecolor: grid,
      tickcolor: grid, automargin: true };
  }
  out.annotations = (layout.annotations || []).map((note) => ({ ...note,
    font: { size: 13, color: colour("muted").trim() } }));
  out.hoverlabel = { bgcolor: colour("panel").trim(), bordercolor: grid, font: { color: text } };
  return out;
}

/* Whiskers of bars contrast with the bars; those of points have the colour of the points. */
function themedTrace(trace) {
  if (trace.type !== "bar") return trace;
  return { ...trace, error_y: { ...trace.error_y, color: colour("text").trim() } };
}

function showPlots() {
  const draw = () => {
    for (const div of document.querySelectorAll("[data-figure]")) {
      const figure = DATA.figures[div.dataset.figure];
      div.style.height = `${figure.layout.height}px`;
      Plotly.react(div, figure.data.map(themedTrace), themed(figure.layout),
        { displayModeBar: false, responsive: true });
    }
  };
  dark.addEventListener("change", draw);
  draw();
}

listenToTabs();
showPlots();
showPictures();
if (document.getElementById("replay")) window.replay = new Replay();
