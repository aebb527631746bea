/* Draws example forecasts over the map: a row per situation, a column per predictor. */
function drawPicture(canvas, row, predictor) {
  const [x, y, extent] = row.window;
  const { width } = fit(canvas);
  const scale = width / extent;
  const ctx = begin(canvas, x, y, scale);
  drawMap(ctx, row.map, scale);
  for (const agent of row.agents) {
    drawPath(ctx, points(agent[6]), colour(CLASSES[agent[0]]), 2, 0.4, scale);
  }
  const pose = (agent) => [agent[3] / 100, agent[4] / 100, agent[5] / 1000];
  row.agents.forEach((agent, number) => {
    const target = row.targets.includes(number);
    const fill = colour(target ? "ego" : CLASSES[agent[0]]);
    ctx.globalAlpha = target ? 1 : 0.75;
    drawBox(ctx, pose(agent), [agent[1] / 100, agent[2] / 100], fill, colour("box-edge"), scale);
    ctx.globalAlpha = 1;
  });
  row.targets.forEach((number, index) => {
    const start = pose(row.agents[number]).slice(0, 2);
    const stroke = colour(seriesColour(DATA.colours[predictor]));
    drawModes(ctx, row.forecasts[predictor].modes[index], start, stroke, scale);
    const truth = points(row.truth[index]);
    drawPath(ctx, truth, colour("truth"), 2, 1, scale, [2, 4.5]);
    drawDot(ctx, truth[truth.length - 2], truth[truth.length - 1], colour("truth"), 3.5, 1, scale);
  });
  drawScale(ctx, canvas, scale);
}

function pictureCaption(row, predictor) {
  const { fde, best } = row.forecasts[predictor];
  const text = document.createElement("span");
  if (fde === null) {
    text.textContent = "no forecast";
    return text;
  }
  const bold = document.createElement("b");
  bold.textContent = `${fde.toFixed(2)} m`;
  text.append("FDE ", bold);
  if (best < fde) text.append(` · nearest mode ${best.toFixed(2)} m`);
  return text;
}

function showPictures() {
  const grid = document.getElementById("picture-grid");
  if (!grid) return;
  const predictors = Object.keys(DATA.pictures[0].forecasts);
  const columns = Math.min(4, Math.max(2, predictors.length));
  grid.style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
  const dialog = document.getElementById("picture-dialog");
  const large = dialog.querySelector("canvas");
  dialog.addEventListener("click", () => dialog.close());
  const drawings = [];
  for (const row of DATA.pictures) {
    const heading = document.createElement("div");
    heading.className = "caption";
    heading.textContent = row.caption;
    grid.append(heading);
    for (const predictor of predictors) {
      const figure = document.createElement("figure"), canvas = document.createElement("canvas");
      const caption = document.createElement("figcaption"), name = document.createElement("h3");
      const dot = document.createElement("i");
      dot.style.background = `var(--${seriesColour(DATA.colours[predictor])})`;
      name.append(dot, predictor.split(":")[0]);
      name.title = predictor;
      caption.append(name, pictureCaption(row, predictor));
      figure.append(canvas, caption);
      figure.tabIndex = 0;
      const enlarge = () => {
        dialog.showModal();
        drawPicture(large, row, predictor);
        dialog.querySelector("p").textContent = `${predictor.split(":")[0]} · ${row.caption}`;
      };
      figure.addEventListener("click", enlarge);
      figure.addEventListener("keydown", (event) => { if (event.key === "Enter") enlarge(); });
      grid.append(figure);
      drawings.push(() => drawPicture(canvas, row, predictor));
    }
  }
  legend(document.getElementById("picture-legend"), [
    ["ego", "forecast agents"], ["car", "cars"], ["heavy", "vans, trucks, buses"],
    ["two-wheeler", "motorcycles"], ["vulnerable", "cyclists and pedestrians"],
    ["truth", "recorded future", "stroke"],
  ]);
  const redraw = () => drawings.forEach((draw) => draw());
  new ResizeObserver(redraw).observe(grid);
  onTheme(redraw);
  redraw();
}
