/* Draws one rollout on a canvas. Poses are interpolated between ticks; forecasts and plans are not. */
const TRAIL_S = 3, FLASH_S = 1.2;

/* What happens in a rollout, decompressed. */
async function unpacked(drive) {
  if (!drive.content) {
    const bytes = Uint8Array.from(atob(drive.body), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    drive.content = { ...drive, ...await new Response(stream).json() };
  }
  return drive.content;
}

function eventColour(name) {
  return colour(/collision/.test(name) ? "alarm" : "warning");
}

/* The pose of an agent between ticks, or null. */
function poseAt(poses, first, tick) {
  const index = tick - first, low = Math.floor(index), share = index - low;
  const a = poses[low], b = poses[low + 1];
  if (!a) return null;
  if (!b || share === 0) return [a[0] / 100, a[1] / 100, a[2] / 1000];
  const turn = Math.atan2(Math.sin((b[2] - a[2]) / 1000), Math.cos((b[2] - a[2]) / 1000));
  return [(a[0] + share * (b[0] - a[0])) / 100, (a[1] + share * (b[1] - a[1])) / 100,
    a[2] / 1000 + share * turn];
}

class Stage {
  constructor(box) {
    this.box = box;
    this.canvas = box.querySelector("canvas");
    this.name = box.querySelector(".name");
    this.event = box.querySelector(".event");
    this.rollout = null;
  }

  show(rollout) {
    this.rollout = rollout;
    this.box.hidden = !rollout;
    this.name.textContent = rollout ? rollout.driver || rollout.name : "";
  }

  /* Draws the rollout at a tick; after its end, its last tick. */
  draw(at, view) {
    const rollout = this.rollout, { width, height } = fit(this.canvas);
    if (!rollout || !width) return;
    this.tick = Math.min(at, rollout.ticks - 1);
    const tick = Math.floor(this.tick);
    const poses = rollout.agents.map((agent) => poseAt(agent.poses, agent.first, this.tick));
    const [left, low, right, high] = DATA.maps[rollout.map].extent;
    const fitted = Math.min(width / (right - left), height / (high - low)) * 0.95;
    this.scale = view.zoom * (view.follow ? Math.max(fitted, width / 110) : fitted);
    const [x, y] = view.follow && poses[0] ? poses[0] : [(left + right) / 2, (low + high) / 2];
    const ctx = begin(this.canvas, x + view.offset[0], y + view.offset[1], this.scale);
    drawMap(ctx, rollout.map, this.scale);
    drawPath(ctx, points(rollout.route), colour("plan"), 5, 0.14, this.scale);
    if (view.forecasts) this.drawForecasts(ctx, tick, poses);
    rollout.agents.forEach((agent, slot) => {
      const stroke = colour(slot ? CLASSES[agent.class] : "ego");
      if (poses[slot]) this.trail(ctx, agent.poses, agent.first, stroke, poses[slot]);
    });
    this.drawPlan(ctx, tick, poses[0]);
    for (let slot = rollout.agents.length - 1; slot >= 0; slot--) {
      if (poses[slot]) this.drawAgent(ctx, slot, poses[slot], view.ghost);
    }
    this.drawEvents(ctx, poses[0]);
    drawScale(ctx, this.canvas, this.scale);
  }

  trail(ctx, poses, first, stroke, pose) {
    const last = Math.floor(this.tick), ticks = Math.round(TRAIL_S / this.rollout.dt);
    let [x, y] = pose;
    ctx.lineCap = "butt";
    for (let tick = last; tick >= Math.max(first, last - ticks); tick--) {
      const point = poses[tick - first];
      if (!point) break;
      const fade = 0.5 * (1 - (this.tick - tick) / (ticks + 1));
      const next = [point[0] / 100, point[1] / 100];
      drawPath(ctx, [x, y, ...next], stroke, 2.2, Math.max(fade, 0), this.scale);
      [x, y] = next;
    }
    ctx.lineCap = "round";
  }

  drawForecasts(ctx, tick, poses) {
    for (const [slot, modes] of this.rollout.forecasts[tick]) {
      const agent = this.rollout.agents[slot];
      const start = agent.poses[tick - agent.first] || poses[slot];
      if (!start) continue;
      drawModes(ctx, modes, [start[0] / 100, start[1] / 100], colour("forecast"), this.scale);
    }
  }

  drawPlan(ctx, tick, ego) {
    const plan = this.rollout.plans[tick];
    if (!plan || !plan.length || !ego) return;
    const xy = points(plan);
    drawPath(ctx, [ego[0], ego[1], ...xy], colour("plan"), 4, 0.9, this.scale);
  }

  drawAgent(ctx, slot, pose, ghost) {
    const agent = this.rollout.agents[slot];
    const size = [agent.size[0] / 100, agent.size[1] / 100];
    if (slot) {
      drawBox(ctx, pose, size, colour(CLASSES[agent.class]), colour("box-edge"), this.scale);
      return;
    }
    const recorded = ghost && poseAt(this.rollout.log, 0, this.tick);
    drawBox(ctx, pose, size, colour("ego"), colour("box-edge"), this.scale);
    if (recorded) drawGhost(ctx, recorded, size, this.scale);
  }

  drawEvents(ctx, ego) {
    const dt = this.rollout.dt;
    const active = this.rollout.events.filter(([, first, last]) =>
      first <= this.tick && (this.tick - last) * dt < FLASH_S);
    this.event.replaceChildren(...active.map(([name]) => {
      const badge = document.createElement("span");
      badge.textContent = name;
      badge.style.background = eventColour(name);
      return badge;
    }));
    for (const [name, first] of active) {
      const age = (this.tick - first) * dt / FLASH_S;
      if (!ego || age > 1) continue;
      ctx.save();
      ctx.globalAlpha = 1 - age;
      ctx.strokeStyle = eventColour(name);
      ctx.lineWidth = 4 / this.scale;
      ctx.beginPath();
      ctx.arc(ego[0], ego[1], 3 + 5 * age, 0, 2 * Math.PI);
      ctx.stroke();
      ctx.restore();
    }
  }
}
