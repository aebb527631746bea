/* Plays rollouts on a canvas. Poses are interpolated between ticks; forecasts and plans are not. */
const TRAIL_S = 3, FLASH_S = 1.2;

class Replay {
  constructor() {
    const get = (name) => document.getElementById("replay-" + name);
    for (const name of ["canvas", "strip", "clock", "event", "method", "scenario", "play", "scrub",
      "speed", "follow", "forecasts", "ghost"]) this[name] = get(name);
    this.tick = 0;
    this.playing = false;
    this.zoom = 1;
    this.offset = [0, 0];
    this.legend();
    this.fillMethods();
    this.listen();
    this.choose();
  }

  legend() {
    legend(document.getElementById("replay-legend"), [
      ["ego", "ego"], ["ghost", "recorded ego", "dashed"], ["plan", "plan", "stroke"],
      ["forecast", "forecasts", "stroke"], ["car", "cars"], ["heavy", "vans, trucks, buses"],
      ["two-wheeler", "motorcycles"], ["vulnerable", "cyclists and pedestrians"],
      ["alarm", "collision"], ["warning", "other events"],
    ]);
  }

  fillMethods() {
    const methods = [...new Set(DATA.drives.map((rollout) => rollout.driver))];
    document.getElementById("replay-method-label").hidden = methods.length < 2;
    this.method.replaceChildren(...methods.map((name) => new Option(name)));
    this.method.value = methods.find((name) => name !== "expert") ?? methods[0];
    this.fillScenarios();
  }

  fillScenarios() {
    const before = this.scenario.selectedOptions[0]?.dataset.name;
    this.scenario.replaceChildren(...DATA.drives.flatMap((rollout, number) => {
      if (rollout.driver !== this.method.value) return [];
      const option = new Option([rollout.name, rollout.tags].filter(Boolean).join(" · "), number);
      option.dataset.name = rollout.name;
      return [option];
    }));
    const same = [...this.scenario.options].find((option) => option.dataset.name === before);
    if (same) same.selected = true;
  }

  listen() {
    this.method.addEventListener("change", () => {
      const tick = this.tick;
      this.fillScenarios();
      this.choose();
      this.seek(Math.min(tick, this.rollout.ticks - 1));
    });
    this.scenario.addEventListener("change", () => this.choose());
    this.play.addEventListener("click", () => this.toggle());
    this.scrub.addEventListener("input", () => this.seek(Number(this.scrub.value)));
    for (const box of [this.follow, this.forecasts, this.ghost]) {
      box.addEventListener("change", () => this.draw());
    }
    this.strip.addEventListener("pointerdown", (event) => {
      const share = event.offsetX / this.strip.clientWidth;
      this.seek(Math.round(share * (this.rollout.ticks - 1)));
    });
    this.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key !== " " && !step) return;
      event.preventDefault();
      if (step) this.seek(Math.floor(this.tick) + step); else this.toggle();
    });
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom = Math.min(8, Math.max(0.25, this.zoom * Math.exp(-event.deltaY / 500)));
      this.draw();
    }, { passive: false });
    this.canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      this.offset[0] -= event.movementX / this.scale;
      this.offset[1] += event.movementY / this.scale;
      this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    dark.addEventListener("change", () => this.draw());
  }

  choose() {
    this.rollout = DATA.drives[Number(this.scenario.value)];
    this.scrub.max = this.rollout.ticks - 1;
    this.zoom = 1;
    this.offset = [0, 0];
    this.seek(0);
  }

  seek(tick) {
    this.tick = Math.min(Math.max(tick, 0), this.rollout.ticks - 1);
    this.draw();
  }

  toggle() {
    this.playing = !this.playing;
    this.play.textContent = this.playing ? "❚❚" : "▶";
    this.play.setAttribute("aria-label", this.playing ? "Pause" : "Play");
    if (!this.playing) return;
    if (this.tick >= this.rollout.ticks - 1) this.tick = 0;
    let before = performance.now();
    const frame = (now) => {
      if (!this.playing) return;
      this.seek(this.tick + (now - before) / 1000 * Number(this.speed.value) / this.rollout.dt);
      before = now;
      if (this.tick >= this.rollout.ticks - 1) this.toggle(); else requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  /* The pose of an agent between ticks, or null. */
  pose(poses, first) {
    const index = this.tick - first, low = Math.floor(index), share = index - low;
    const a = poses[low], b = poses[low + 1];
    if (!a) return null;
    if (!b || share === 0) return [a[0] / 100, a[1] / 100, a[2] / 1000];
    const turn = Math.atan2(Math.sin((b[2] - a[2]) / 1000), Math.cos((b[2] - a[2]) / 1000));
    return [(a[0] + share * (b[0] - a[0])) / 100, (a[1] + share * (b[1] - a[1])) / 100,
      a[2] / 1000 + share * turn];
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

  centre(ego) {
    if (this.follow.checked && ego) return [ego[0], ego[1]];
    const [left, low, right, high] = DATA.maps[this.rollout.map].extent;
    return [(left + right) / 2, (low + high) / 2];
  }

  draw() {
    const { width, height } = fit(this.canvas);
    if (!width) return;
    const rollout = this.rollout, tick = Math.floor(this.tick);
    const poses = rollout.agents.map((agent) => this.pose(agent.poses, agent.first));
    const [left, low, right, high] = DATA.maps[rollout.map].extent;
    const fitted = Math.min(width / (right - left), height / (high - low)) * 0.95;
    this.scale = this.zoom * (this.follow.checked ? Math.max(fitted, width / 130) : fitted);
    const [x, y] = this.centre(poses[0]);
    const ctx = begin(this.canvas, x + this.offset[0], y + this.offset[1], this.scale);
    drawMap(ctx, rollout.map, this.scale);
    drawPath(ctx, points(rollout.route), colour("plan"), 5, 0.14, this.scale);
    if (this.forecasts.checked) this.drawForecasts(ctx, tick, poses);
    rollout.agents.forEach((agent, slot) => {
      const stroke = colour(slot ? CLASSES[agent.class] : "ego");
      if (poses[slot]) this.trail(ctx, agent.poses, agent.first, stroke, poses[slot]);
    });
    this.drawPlan(ctx, tick, poses[0]);
    for (let slot = rollout.agents.length - 1; slot >= 0; slot--) {
      if (poses[slot]) this.drawAgent(ctx, slot, poses[slot]);
    }
    this.drawEvents(ctx, poses[0]);
    drawScale(ctx, this.canvas, this.scale);
    this.drawStrip();
    const speed = rollout.speed[tick];
    const speedText = speed === null ? "" : ` · ${(3.6 * speed).toFixed(0)} km/h`;
    this.clock.textContent = `${(this.tick * rollout.dt).toFixed(1)} s${speedText}`;
    this.scrub.value = tick;
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

  drawAgent(ctx, slot, pose) {
    const agent = this.rollout.agents[slot];
    const size = [agent.size[0] / 100, agent.size[1] / 100];
    if (slot) {
      drawBox(ctx, pose, size, colour(CLASSES[agent.class]), colour("box-edge"), this.scale);
      return;
    }
    const recorded = this.ghost.checked && this.pose(this.rollout.log, 0);
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
      badge.style.background = this.eventColour(name);
      return badge;
    }));
    for (const [name, first] of active) {
      const age = (this.tick - first) * dt / FLASH_S;
      if (!ego || age > 1) continue;
      ctx.save();
      ctx.globalAlpha = 1 - age;
      ctx.strokeStyle = this.eventColour(name);
      ctx.lineWidth = 4 / this.scale;
      ctx.beginPath();
      ctx.arc(ego[0], ego[1], 3 + 5 * age, 0, 2 * Math.PI);
      ctx.stroke();
      ctx.restore();
    }
  }

  eventColour(name) {
    return colour(/collision/.test(name) ? "alarm" : "warning");
  }

  /* Speed of the ego and the recorded ego over time, events as marks, the current time as a bar. */
  drawStrip() {
    const { width, height, ratio } = fit(this.strip);
    const ctx = this.strip.getContext("2d"), rollout = this.rollout;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    const top = Math.max(5, ...rollout.speed.filter(Number.isFinite), ...rollout.log_speed
      .filter(Number.isFinite)) * 1.1;
    const px = (tick) => tick / Math.max(1, rollout.ticks - 1) * width;
    const py = (speed) => height - 4 - speed / top * (height - 10);
    const line = (speeds, stroke, dash) => {
      ctx.strokeStyle = stroke;
      ctx.lineWidth = 1.8;
      ctx.setLineDash(dash);
      ctx.beginPath();
      let pen = false;
      speeds.forEach((speed, tick) => {
        if (speed !== null && pen) ctx.lineTo(px(tick), py(speed));
        if (speed !== null && !pen) ctx.moveTo(px(tick), py(speed));
        pen = speed !== null;
      });
      ctx.stroke();
      ctx.setLineDash([]);
    };
    ctx.fillStyle = colour("muted");
    ctx.font = "11px system-ui, sans-serif";
    ctx.fillText("speed", 4, 12);
    line(rollout.log_speed, colour("muted"), [4, 3]);
    line(rollout.speed, colour("ego"), []);
    for (const [name, first, last] of rollout.events) {
      ctx.fillStyle = this.eventColour(name);
      ctx.globalAlpha = 0.18;
      ctx.fillRect(px(first), 0, Math.max(2, px(last) - px(first)), height);
      ctx.globalAlpha = 1;
      ctx.fillRect(px(first) - 1, 0, 2, height);
    }
    ctx.fillStyle = colour("text");
    ctx.fillRect(px(this.tick) - 1, 0, 2, height);
  }
}
