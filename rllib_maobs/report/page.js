"use strict";
// What Python has measured is in the element #data: charts as Bokeh takes them, and episodes. See page.py.
const data = JSON.parse(document.getElementById("data").textContent);
const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const dark = matchMedia("(prefers-color-scheme: dark)");

// Charts. A line is named after its algorithm and its glyph tagged with its x-axis; buttons say which are shown.
const figures = new Map();

async function draw(element) {
  figures.set(element, null);
  const chart = data.charts[element.id];
  await Bokeh.embed.embed_item(chart, element.id);
  figures.set(element, Bokeh.documents.flatMap((it) => it.roots()).find((root) => root.id === chart.root_id));
  paint(element);
  show(element);
}

function paint(element) {
  const figure = figures.get(element);
  for (const axis of [...figure.below, ...figure.left]) {
    axis.setv({
      axis_label_text_color: color("quiet"), major_label_text_color: color("quiet"), axis_line_color: color("line"),
      major_tick_line_color: color("line"), minor_tick_line_color: null,
    });
  }
  for (const part of figure.center) if ("grid_line_color" in part) part.grid_line_color = color("line");
  figure.outline_line_color = null;
}

function show(element) {
  const figure = figures.get(element);
  const section = element.closest(".task");
  const hidden = new Set(
    [...section.querySelectorAll('[data-line][aria-pressed="false"]')].map((button) => button.dataset.line));
  const axis = section.querySelector(".axis input:checked")?.value;
  for (const line of figure.renderers) {
    const { tags } = line.glyph;
    line.visible = !hidden.has(line.name) && (tags.length === 0 || tags.includes(axis));
  }
  const titles = figure.below[0].tags;
  if (titles.length) figure.below[0].axis_label = titles[axis === "time" ? 1 : 0];
}

const redraw = (section) => section.querySelectorAll(".plot").forEach((plot) => figures.get(plot) && show(plot));
const seen = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) if (isIntersecting && !figures.has(target)) draw(target);
}, { rootMargin: "600px" });
const plots = [...document.querySelectorAll(".plot")];
for (const plot of plots) seen.observe(plot);
// The others when there is nothing else to do: who prints the page, or searches in it, has not scrolled to them.
const idle = window.requestIdleCallback ?? ((then) => setTimeout(then, 100));
async function drawRest() {
  const plot = plots.find((it) => !figures.has(it));
  if (!plot) return;
  await draw(plot);
  idle(drawRest);
}
addEventListener("load", () => idle(drawRest));
// Paper is narrower, and white. Charts are not drawn anew for it: they keep their width, and page.css inverts dark ones.
addEventListener("beforeprint", () => {
  document.documentElement.classList.toggle("dark", dark.matches);
  const widths = plots.map((plot) => plot.clientWidth);
  plots.forEach((plot, number) => { plot.style.width = `${widths[number]}px`; });
});
addEventListener("afterprint", () => plots.forEach((plot) => { plot.style.width = ""; }));
dark.addEventListener("change", () => figures.forEach((figure, element) => figure && paint(element)));
for (const section of document.querySelectorAll(".task")) {
  section.addEventListener("change", (event) => event.target.closest(".axis") && redraw(section));
  section.addEventListener("click", (event) => {
    const button = event.target.closest("[data-line]");
    if (!button) return;
    const pressed = button.getAttribute("aria-pressed") === "true";
    button.setAttribute("aria-pressed", String(!pressed));
    redraw(section);
  });
}

// The player.
const TEAM = ["#4a7fd4", "#de872e", "#9a6bc9", "#23a0a5", "#cf5f97", "#a3795a", "#6f8f2f", "#6f7fc0", "#b39a1e"];
const PREY = "#38a04a", TRAIL = 25, FLASH = 3;

class Player {
  constructor(root) {
    this.episodes = data.episodes[root.dataset.section];
    [this.choice, this.canvas] = [root.querySelector("select"), root.querySelector("canvas")];
    [this.button, this.slider] = [root.querySelector(".play"), root.querySelector("input")];
    [this.strip, this.speed] = [root.querySelector(".strip"), root.querySelector(".speed")];
    [this.text, this.summary] = [root.querySelector("output"), root.querySelector(".summary")];
    this.choice.addEventListener("change", () => this.open());
    this.button.addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    this.slider.addEventListener("input", () => {
      this.now = Number(this.slider.value);
      this.pause();
    });
    this.canvas.addEventListener("click", () => this.button.click());
    new ResizeObserver(() => this.render()).observe(this.canvas);
    dark.addEventListener("change", () => this.render());
    this.open();
  }

  open() {
    this.pause();
    this.episode = this.episodes[Number(this.choice.value)];
    this.end = this.episode.positions.length - 1;
    this.slider.max = this.end;
    const [halfWidth, halfHeight] = this.episode.view;
    this.canvas.style.aspectRatio = `${halfWidth} / ${halfHeight}`;
    this.canvas.setAttribute("aria-label", `${this.choice.selectedOptions[0].text}, drawn from above`);
    this.summary.textContent = this.episode.summary;
    this.go(0);
  }

  play() {
    if (this.now >= this.end) this.go(0);
    this.playing = true;
    this.button.textContent = "Pause";
    this.text.ariaLive = "off"; // screen readers need not say every step
    this.before = performance.now();
    requestAnimationFrame((time) => this.tick(time));
  }

  pause() {
    this.playing = false;
    this.button.textContent = "Play";
    this.text.ariaLive = "polite";
    if (this.episode) this.go(Math.round(this.now));
  }

  tick(time) {
    if (!this.playing) return;
    const steps = (Math.max(time - this.before, 0) / 1000) * this.episode.fps * Number(this.speed.value);
    this.before = time;
    this.go(Math.min(this.now + steps, this.end));
    if (this.now >= this.end) this.pause();
    else requestAnimationFrame((next) => this.tick(next));
  }

  go(now) {
    this.now = now;
    const step = Math.floor(now);
    this.slider.value = step;
    const touching = this.episode.contact[step].map((body) => this.episode.bodies[body].name);
    this.text.textContent = `step ${step} of ${this.end}` + (touching.length ? `; in contact: ${touching.join(", ")}` : "");
    this.render();
  }

  // A body's place at a time between two steps.
  place(body, time) {
    const { positions, fixed } = this.episode;
    const movers = positions[0].length / 2;
    if (body >= movers) return [fixed[2 * (body - movers)], fixed[2 * (body - movers) + 1]];
    const step = Math.min(Math.floor(time), this.end), next = Math.min(step + 1, this.end), part = time - step;
    return [0, 1].map((xy) => (1 - part) * positions[step][2 * body + xy] + part * positions[next][2 * body + xy]);
  }

  render() {
    const { bodies, view: [halfWidth, halfHeight], walls, contact } = this.episode;
    const width = this.canvas.clientWidth * devicePixelRatio;
    if (!width) return;
    const scale = width / (2 * halfWidth);
    this.canvas.width = width;
    this.canvas.height = 2 * halfHeight * scale;
    const pen = this.canvas.getContext("2d");
    pen.setTransform(scale, 0, 0, -scale, width / 2, halfHeight * scale); // y points up in the world
    const thin = 2 / scale * devicePixelRatio;
    const disc = ([x, y], radius) => { pen.beginPath(); pen.arc(x, y, radius, 0, 2 * Math.PI); };
    const step = Math.floor(this.now);
    const paint = bodies.map((body, number) =>
      body.kind === "target" ? ("owner" in body ? TEAM[body.owner % TEAM.length] : color("quiet"))
        : !body.moves ? color("solid") : body.kind !== bodies[0].kind ? PREY : TEAM[number % TEAM.length]);

    pen.fillStyle = color("solid");
    for (const [x, y, offset] of walls) {
      const far = 4 * (halfWidth + halfHeight);
      pen.save();
      pen.transform(x, y, -y, x, 0, 0);
      pen.fillRect(offset, -far, far, 2 * far);
      pen.restore();
    }
    bodies.forEach((body, number) => {
      pen.lineWidth = thin;
      pen.fillStyle = pen.strokeStyle = paint[number];
      disc(this.place(number, this.now), body.radius);
      if (body.kind === "target") pen.stroke();
      else if (!body.moves) pen.fill();
    });
    bodies.forEach((body, number) => {
      if (!body.moves) return;
      pen.strokeStyle = paint[number];
      for (let age = 0; age < Math.min(TRAIL, this.now); age++) {
        pen.globalAlpha = 0.7 * (1 - age / TRAIL);
        pen.beginPath();
        pen.moveTo(...this.place(number, this.now - age));
        pen.lineTo(...this.place(number, Math.max(this.now - age - 1, 0)));
        pen.stroke();
      }
      pen.globalAlpha = 1;
      pen.fillStyle = paint[number];
      disc(this.place(number, this.now), body.radius);
      pen.fill();
    });
    pen.strokeStyle = color("flash");
    for (let age = FLASH - 1; age >= 0; age--) {
      pen.lineWidth = thin * (1 + FLASH - age) / 1.5;
      for (const body of contact[step - age] ?? []) {
        disc(this.place(body, this.now), bodies[body].radius + pen.lineWidth / 2);
        pen.stroke();
      }
    }
    pen.fillStyle = color("ink");
    bodies.forEach((body, number) => {
      if (body.kind !== "target") return; // a dot, to be seen under the one who is there
      disc(this.place(number, this.now), 1.5 * thin);
      pen.fill();
    });
    this.mark();
  }

  mark() {
    const { strip, end } = this;
    strip.width = strip.clientWidth;
    strip.height = strip.clientHeight;
    const pen = strip.getContext("2d"), left = 8, step = (strip.width - 2 * left) / end; // half of the slider's knob
    pen.fillStyle = color("flash");
    this.episode.contact.forEach((touching, number) => {
      if (touching.length) pen.fillRect(left + (number - 0.5) * step, 0, Math.max(step, 2), strip.height);
    });
  }
}

const players = [...document.querySelectorAll(".player")].map((root) => new Player(root));
