/* Plays two rollouts of a scenario side by side. The fragment of the address names what is shown. */
class Player {
  constructor() {
    const get = (name) => document.getElementById("replay-" + name);
    for (const name of ["a", "b", "scenario", "play", "scrub", "speed", "follow", "forecasts",
      "ghost", "strip", "clock", "part", "link", "save", "commands", "stages"]) {
      this[name] = get(name);
    }
    this.shown = [...this.stages.querySelectorAll(".stage")].map((box) => new Stage(box));
    this.view = { zoom: 1, offset: [0, 0] };
    this.tick = 0;
    this.playing = false;
    this.condition = 0;
    this.request = 0;
    this.folder = location.protocol === "file:"
      ? decodeURIComponent(location.pathname).replace(/\/[^/]*$/, "") : "OUT";
    this.legend();
    this.listen();
  }

  get drives() {
    return DATA.drives.filter((drive) => drive.condition === this.condition);
  }

  get rollout() {
    return this.shown[0].rollout;
  }

  get ticks() {
    return Math.max(...this.shown.map((stage) => stage.rollout ? stage.rollout.ticks : 1));
  }

  legend() {
    legend(document.getElementById("replay-legend"), [
      ["ego", "ego"], ["ghost", "recorded ego", "dashed"], ["plan", "plan", "stroke"],
      ["forecast", "forecasts", "stroke"], ["car", "cars"], ["heavy", "vans, trucks, buses"],
      ["two-wheeler", "motorcycles"], ["vulnerable", "cyclists and pedestrians"],
      ["alarm", "collision"], ["warning", "other events"],
    ]);
  }

  /* Shows a scenario with one or two methods at a tick; what is not given or known is chosen. */
  async open({ drive, a, b, tick = 0, condition = this.condition } = {}) {
    this.condition = DATA.drives.some((each) => each.condition === condition) ? condition
      : DATA.drives[0].condition;
    const names = [...new Set(this.drives.map((each) => each.name))];
    const name = names.includes(drive) ? drive : names[0];
    const methods = this.drives.filter((each) => each.name === name).map((each) => each.driver);
    const tags = this.tagsOf();
    this.scenario.replaceChildren(...names.map((each) =>
      new Option([each, tags.get(each)].filter(Boolean).join(" · "), each)));
    this.a.replaceChildren(...methods.map((each) => new Option(each)));
    this.b.replaceChildren(new Option("nothing", ""), ...methods.map((each) => new Option(each)));
    this.scenario.value = name;
    this.a.value = methods.includes(a) ? a
      : methods.find((each) => each !== "expert" && each !== b) ?? methods[0];
    this.b.value = methods.includes(b) ? b : "";
    const request = ++this.request;
    const chosen = [this.a.value, this.b.value].map((method) =>
      this.drives.find((each) => each.name === name && each.driver === method));
    if (!this.b.value && methods[0] !== "") chosen[1] = undefined;
    const rollouts = await Promise.all(chosen.map((each) => each && unpacked(each)));
    if (request !== this.request) return;
    this.shown.forEach((stage, number) => stage.show(rollouts[number]));
    this.stages.classList.toggle("two", Boolean(rollouts[1]));
    this.view.zoom = 1;
    this.view.offset = [0, 0];
    this.scrub.max = this.ticks - 1;
    this.parted = rollouts[1] ? this.findParting(rollouts) : null;
    this.part.hidden = this.parted === null;
    if (this.parted !== null) {
      this.part.textContent = `part at ${(this.parted * this.rollout.dt).toFixed(1)} s`;
    }
    this.showCommands(chosen.filter(Boolean));
    this.seek(Number.isFinite(tick) ? tick : 0);
  }

  tagsOf() {
    return new Map(this.drives.map((each) => [each.name, each.tags]));
  }

  /* The first tick at which the egos are apart, or null. */
  findParting(rollouts) {
    const ticks = Math.min(...rollouts.map((each) => each.ticks));
    for (let tick = 0; tick < ticks; tick++) {
      const [p, q] = rollouts.map(({ agents: [ego] }) => ego.poses[tick - ego.first]);
      if (!p !== !q || (p && Math.hypot(p[0] - q[0], p[1] - q[1]) > DATA.parted_cm)) return tick;
    }
    return rollouts[0].ticks === rollouts[1].ticks ? null : ticks;
  }

  showCommands(drives) {
    const quoted = (text) => `'${text.replaceAll("'", "'\\''")}'`;
    const rows = [];
    const add = (heading, command) => {
      const term = document.createElement("dt"), text = document.createElement("dd");
      const code = document.createElement("code"), copy = document.createElement("button");
      term.textContent = heading;
      code.textContent = command;
      copy.textContent = "Copy";
      copy.setAttribute("aria-label", `Copy: ${heading}`);
      copy.addEventListener("click", () => {
        getSelection().selectAllChildren(code);
        navigator.clipboard?.writeText(command).catch(() => {});
      });
      text.append(code, copy);
      rows.push(term, text);
    };
    for (const drive of drives) {
      const who = drive.driver || drive.name;
      if (drive.command) {
        const here = quoted(`${this.folder}/`).slice(0, -1);
        const command = drive.command.replace("'OUT/", () => here);
        add(`Drive again: ${who}`, command);
      }
      add(`Watch: ${who}`, `asp-env watch ${quoted(`${this.folder}/${drive.file}`)}`);
    }
    this.commands.replaceChildren(...rows);
  }

  listen() {
    const reopen = () => this.open({ drive: this.scenario.value, a: this.a.value, b: this.b.value,
      tick: this.tick }).then(() => this.remember());
    this.a.addEventListener("change", reopen);
    this.b.addEventListener("change", reopen);
    this.scenario.addEventListener("change", () => this.choose(0));
    this.play.addEventListener("click", () => this.toggle());
    this.scrub.addEventListener("input", () => this.seek(Number(this.scrub.value)));
    this.scrub.addEventListener("change", () => this.remember());
    this.part.addEventListener("click", () => this.goToParting());
    this.save.addEventListener("click", () => this.savePicture());
    this.link.addEventListener("click", () => {
      navigator.clipboard?.writeText(this.link.href).catch(() => {});
    });
    for (const box of [this.follow, this.forecasts, this.ghost]) {
      box.addEventListener("change", () => this.draw());
    }
    this.strip.addEventListener("pointerdown", (event) => {
      const share = event.offsetX / this.strip.clientWidth;
      this.seek(Math.round(share * (this.ticks - 1)));
      this.remember();
    });
    document.getElementById("replay").addEventListener("keydown", (event) => this.press(event));
    for (const { canvas } of this.shown) {
      canvas.addEventListener("wheel", (event) => {
        event.preventDefault();
        const factor = Math.exp(-event.deltaY / 500);
        this.view.zoom = Math.min(8, Math.max(0.25, this.view.zoom * factor));
        this.draw();
      }, { passive: false });
      canvas.addEventListener("pointermove", (event) => {
        if (!event.buttons) return;
        this.view.offset[0] -= event.movementX / this.shown[0].scale;
        this.view.offset[1] += event.movementY / this.shown[0].scale;
        this.draw();
      });
    }
    new ResizeObserver(() => this.draw()).observe(this.stages);
    onTheme(() => this.draw());
  }

  press(event) {
    if (/^(SELECT|INPUT|BUTTON|A)$/.test(event.target.tagName) || event.ctrlKey || event.metaKey) {
      return;
    }
    const at = Math.floor(this.tick);
    const keys = {
      " ": () => this.toggle(),
      ArrowLeft: () => this.seek(at - 1),
      ArrowRight: () => this.seek(at + 1),
      Home: () => this.seek(0),
      End: () => this.seek(this.ticks - 1),
      d: () => this.goToParting(),
      n: () => this.choose(1),
      p: () => this.choose(-1),
    };
    if (!Object.hasOwn(keys, event.key)) return;
    event.preventDefault();
    keys[event.key]();
    if (event.key !== " ") this.remember();
  }

  /* The scenario that is some places further in the list than the selected one. */
  choose(step) {
    const options = [...this.scenario.options];
    const index = (this.scenario.selectedIndex + step + options.length) % options.length;
    this.open({ drive: options[index].value, a: this.a.value, b: this.b.value })
      .then(() => this.remember());
  }

  goToParting() {
    if (this.parted !== null) this.seek(this.parted);
    this.remember();
  }

  seek(tick) {
    this.tick = Math.min(Math.max(tick, 0), this.ticks - 1);
    this.draw();
  }

  get fragment() {
    const state = { drive: this.scenario.value, a: this.a.value };
    if (this.b.value) state.b = this.b.value;
    if (DATA.conditions.length > 1) state.condition = this.condition;
    return "#" + new URLSearchParams({ ...state, tick: Math.floor(this.tick) });
  }

  /* Writes what is shown into the address, so that a reload or a link shows it again. */
  remember() {
    history.replaceState(null, "", this.fragment);
  }

  toggle() {
    this.playing = !this.playing;
    this.play.textContent = this.playing ? "❚❚" : "▶";
    this.play.setAttribute("aria-label", this.playing ? "Pause" : "Play");
    if (!this.playing) {
      this.remember();
      return;
    }
    if (this.tick >= this.ticks - 1) this.tick = 0;
    let before = performance.now();
    const frame = (now) => {
      if (!this.playing) return;
      this.seek(this.tick + (now - before) / 1000 * Number(this.speed.value) / this.rollout.dt);
      before = now;
      if (this.tick >= this.ticks - 1) this.toggle(); else requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  draw() {
    if (!this.rollout) return;
    const view = { ...this.view, follow: this.follow.checked, ghost: this.ghost.checked,
      forecasts: this.forecasts.checked };
    for (const stage of this.shown) stage.draw(this.tick, view);
    this.drawStrip();
    const speeds = this.shown.filter((stage) => stage.rollout).map(({ rollout }) => {
      const speed = rollout.speed[Math.min(Math.floor(this.tick), rollout.ticks - 1)];
      return speed === null ? "–" : printed(3.6 * speed, 0);
    });
    const seconds = (this.tick * this.rollout.dt).toFixed(1);
    this.clock.textContent = `tick ${Math.floor(this.tick)} · ${seconds} s · ${speeds.join(" and ")} km/h`;
    this.scrub.value = Math.floor(this.tick);
    this.link.href = this.fragment;
  }

  /* Speeds of the egos and the recorded ego over time, events as marks, the tick as a bar. */
  drawStrip() {
    const { width, height, ratio } = fit(this.strip);
    const ctx = this.strip.getContext("2d");
    const rollouts = this.shown.map((stage) => stage.rollout).filter(Boolean);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    const speeds = [...rollouts.map((each) => each.speed), this.rollout.log_speed];
    const top = Math.max(5, ...speeds.flat().filter(Number.isFinite)) * 1.1;
    const px = (tick) => tick / Math.max(1, this.ticks - 1) * width;
    const py = (speed) => height - 4 - speed / top * (height - 24);
    const line = (values, stroke, dash) => {
      ctx.strokeStyle = stroke;
      ctx.lineWidth = 1.8;
      ctx.setLineDash(dash);
      ctx.beginPath();
      let pen = false;
      values.forEach((speed, tick) => {
        if (speed !== null && pen) ctx.lineTo(px(tick), py(speed));
        if (speed !== null && !pen) ctx.moveTo(px(tick), py(speed));
        pen = speed !== null;
      });
      ctx.stroke();
      ctx.setLineDash([]);
    };
    ctx.font = "12px system-ui, sans-serif";
    let x = 4;
    const label = (text, fill) => {
      ctx.fillStyle = fill;
      ctx.fillText(text, x, 12);
      x += ctx.measureText(text).width + 14;
    };
    const colours = [colour("ego"), colour("second")];
    const names = rollouts.map((each) => each.driver || each.name);
    const fits = ctx.measureText(names.join("")).width + 220 < width;
    label("speed:", colour("muted"));
    names.forEach((name, i) => label(fits ? name : ["first", "second"][i], colours[i]));
    label("recorded (dashed)", colour("muted"));
    line(this.rollout.log_speed, colour("muted"), [4, 3]);
    rollouts.forEach((each, number) => line(each.speed, colours[number], []));
    for (const [name, first, last] of rollouts.flatMap((each) => each.events)) {
      ctx.fillStyle = eventColour(name);
      ctx.globalAlpha = 0.18;
      ctx.fillRect(px(first), 18, Math.max(2, px(last) - px(first)), height);
      ctx.globalAlpha = 1;
      ctx.fillRect(px(first) - 1, 18, 2, height);
    }
    if (this.parted !== null) {
      ctx.strokeStyle = ctx.fillStyle = colour("text");
      ctx.setLineDash([3, 3]);
      ctx.beginPath();
      ctx.moveTo(px(this.parted), 18);
      ctx.lineTo(px(this.parted), height);
      ctx.stroke();
      ctx.setLineDash([]);
      ctx.fillText("part", Math.min(px(this.parted) + 4, width - 26), 28);
    }
    ctx.fillStyle = colour("text");
    ctx.fillRect(px(this.tick) - 1, 18, 2, height);
  }

  /* Saves what is shown as one picture. */
  savePicture() {
    const canvases = this.shown.filter((stage) => stage.rollout).map((stage) => stage.canvas);
    const picture = document.createElement("canvas");
    picture.width = canvases.reduce((sum, canvas) => sum + canvas.width, 8 * (canvases.length - 1));
    picture.height = Math.max(...canvases.map((canvas) => canvas.height));
    let x = 0;
    for (const canvas of canvases) {
      picture.getContext("2d").drawImage(canvas, x, 0);
      x += canvas.width + 8;
    }
    picture.toBlob((blob) => download(blob, `${this.scenario.value}-${Math.floor(this.tick)}.png`));
  }
}

/* The state that a fragment names, or null for a fragment that is an anchor. */
function stateOf(hash) {
  const state = new URLSearchParams(hash.slice(1));
  if (!state.has("drive")) return null;
  const number = (name) => Number(state.get(name) ?? 0);
  return { drive: state.get("drive"), a: state.get("a"), b: state.get("b"), tick: number("tick"),
    condition: number("condition") };
}
