/* Theme, tabs, folded columns, the choice of a condition, links to drives, and initialisation. */
const THEMES = { auto: "◐ auto", light: "☀ light", dark: "☾ dark" };

function listenToTheme() {
  const button = document.getElementById("theme"), names = Object.keys(THEMES);
  let stored = null;
  try { stored = localStorage.getItem("theme"); } catch { /* storage is not allowed */ }
  let theme = names.includes(stored) ? stored : "auto";
  const apply = () => {
    button.textContent = THEMES[theme];
    setTheme(theme);
  };
  button.addEventListener("click", () => {
    theme = names[(names.indexOf(theme) + 1) % names.length];
    try { localStorage.setItem("theme", theme); } catch { /* storage is not allowed */ }
    apply();
  });
  apply();
}

function listenToTabs() {
  for (const tabs of document.querySelectorAll(".tabs")) {
    const buttons = [...tabs.querySelectorAll(":scope > [role=tablist] > [role=tab]")];
    const panels = [...tabs.querySelectorAll(":scope > [role=tabpanel]")];
    const select = (selected) => {
      buttons.forEach((button, n) => {
        button.setAttribute("aria-selected", String(n === selected));
        button.tabIndex = n === selected ? 0 : -1;
      });
      panels.forEach((panel, n) => { panel.hidden = n !== selected; });
      foldColumns();
    };
    buttons.forEach((button, n) => {
      button.tabIndex = n ? -1 : 0;
      button.addEventListener("click", () => select(n));
      button.addEventListener("keydown", (event) => {
        const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        if (!step) return;
        event.preventDefault();
        const next = (n + step + buttons.length) % buttons.length;
        select(next);
        buttons[next].focus();
      });
    });
  }
}

/* Hides the columns that do not fit; a button below the table shows them. */
function foldColumns() {
  for (const box of document.querySelectorAll(".folding")) {
    const table = box.querySelector("table"), button = box.nextElementSibling;
    const headings = [...table.querySelectorAll("thead th")];
    if (!box.clientWidth) continue;
    const style = getComputedStyle(table);
    const names = parseFloat(style.getPropertyValue("--names-px"));
    const one = parseFloat(style.getPropertyValue("--column-px"));
    const fitting = Math.max(1, Math.floor((box.clientWidth - names) / one));
    const open = button.getAttribute("aria-expanded") === "true";
    const hidden = Math.max(0, headings.length - 1 - fitting);
    for (const row of table.rows) {
      [...row.cells].forEach((cell, n) => { cell.hidden = !open && n > fitting; });
    }
    table.style.setProperty("--columns", open ? headings.length - 1 : Math.min(fitting, headings.length - 1));
    button.hidden = !hidden;
    button.textContent = open ? "Fewer columns" : `${hidden} more column${hidden === 1 ? "" : "s"}`;
  }
}

function listenToFolds() {
  for (const button of document.querySelectorAll(".more")) {
    button.addEventListener("click", () => {
      const open = button.getAttribute("aria-expanded") === "true";
      button.setAttribute("aria-expanded", String(!open));
      foldColumns();
    });
  }
  for (const details of document.querySelectorAll("details")) {
    details.addEventListener("toggle", foldColumns);
  }
  new ResizeObserver(foldColumns).observe(document.querySelector("main"));
}

/* Shows the part of one condition, and links the navigation to its sections. */
function chooseCondition(number) {
  for (const part of document.querySelectorAll("[data-part]")) {
    part.hidden = Number(part.dataset.part) !== number;
  }
  const select = document.getElementById("condition");
  if (select) select.value = String(number);
  for (const link of document.querySelectorAll("nav a")) {
    const name = link.dataset.section ??= link.hash.slice(1);
    const section = document.querySelector(`[data-part="${number}"] [data-section="${name}"]`);
    const shared = document.querySelector(`main > #${name}`);
    link.hidden = !section && !shared;
    link.href = `#${section ? section.id : name}`;
  }
  foldColumns();
}

function listenToConditions() {
  document.getElementById("condition")?.addEventListener("change", (event) =>
    chooseCondition(Number(event.target.value)));
  for (const button of document.querySelectorAll("[data-choose]")) {
    button.addEventListener("click", () => chooseCondition(Number(button.dataset.choose)));
  }
  chooseCondition(0);
}

function showPlayer() {
  document.getElementById("player").scrollIntoView({ block: "start" });
  window.player.stages.focus({ preventScroll: true });
}

const shownCondition = () =>
  Number(document.querySelector("[data-part]:not([hidden])")?.dataset.part ?? 0);

/* Opens a drive of a figure, in which only the name of the method is known, beside the reference. */
function openFromBar(name, label) {
  const condition = shownCondition();
  const link = document.querySelector(`[data-part="${condition}"] a.open`);
  const drivers = DATA.drives.filter((d) => d.name === name && d.condition === condition)
    .map((d) => d.driver);
  const a = drivers.find((driver) => driver === label || driver.endsWith(` + ${label}`));
  window.player.open({ drive: name, a, b: link?.dataset.b, condition }).then(() => {
    window.player.remember();
    showPlayer();
  });
}

function listenToDrives() {
  if (!document.getElementById("replay")) return;
  window.player = new Player();
  for (const link of document.querySelectorAll("a.open")) {
    link.addEventListener("click", (event) => {
      event.preventDefault();
      window.player.open({ drive: link.dataset.drive, a: link.dataset.a, b: link.dataset.b,
        condition: shownCondition() }).then(() => {
        window.player.remember();
        showPlayer();
      });
    });
  }
  const follow = async (state) => {
    if (!state) return;
    if (state.condition < DATA.conditions.length) chooseCondition(state.condition);
    await window.player.open(state);
    showPlayer();
  };
  addEventListener("hashchange", () => follow(stateOf(location.hash)));
  const state = stateOf(location.hash), first = document.querySelector("a.open");
  if (state) follow(state);
  else window.player.open(first ? { drive: first.dataset.drive, a: first.dataset.a, b: first.dataset.b } : {});
}

listenToTheme();
listenToTabs();
listenToConditions();
listenToFolds();
showCharts();
showPictures();
listenToDrives();
