// What keys, pointers and menus do.

const FURTHER = 1.4;

class Controls {
  constructor(page) {
    Object.assign(this, { page, pointers: new Map() });
    for (const name of ["quantity", "band", "rig"]) {
      part(name).addEventListener("change", (event) => this.choose(name, event.target.selectedIndex));
    }
    part("view").addEventListener("change", () => this.look());
    for (const name of ["single", "fields"]) {
      part(name).addEventListener("change", (event) => { page.state[name] = event.target.checked; page.refresh(); });
    }
    part("menus").addEventListener("submit", (event) => event.preventDefault());
    part("recolor").addEventListener("click", () => { page.fitColors(); page.refresh(); });
    part("closer").addEventListener("click", () => this.zoom(FURTHER));
    part("farther").addEventListener("click", () => this.zoom(1 / FURTHER));
    this.listen(part("map"));
    new ResizeObserver(() => page.draw()).observe(part("map"));
    this.fillMenus();
    this.fillViews();
  }

  choose(name, index) {
    const { page } = this, old = { band: page.band.name, rig: page.choice.name };
    page.state[name] = index;
    const kept = (choices, wanted) => Math.max(0, choices.findIndex((one) => one.name === wanted));
    if (name === "quantity") page.state.band = kept(page.quantity.bands, old.band);
    if (name !== "rig") page.state.rig = kept(page.band.rigs, old.rig);
    this.fillMenus();
    page.fitColors();
    page.refresh();
  }

  fillMenus() {
    const { page } = this;
    const lists = { quantity: page.choices, band: page.quantity.bands, rig: page.band.rigs };
    for (const [name, choices] of Object.entries(lists)) {
      part(name).replaceChildren(...choices.map((one) => made("option", one.name)));
      part(name).selectedIndex = page.state[name];
    }
  }

  fillViews() {
    part("view").replaceChildren(...[...this.page.content.views, { name: "all observed cells" }].map((one) => made("option", one.name)));
    this.look();
  }

  look() {
    const { page } = this, { views } = page.content, { selectedIndex } = part("view");
    const { x, y } = selectedIndex < views.length ? views[selectedIndex] : page.content.rasters[page.choice.map.raster].observed_bounds;
    page.view.fit(x, y);
    page.fitColors();
    page.refresh();
  }

  zoom(factor, pixel) {
    this.page.view.zoom(factor, pixel);
    this.page.draw();
  }

  listen(canvas) {
    const { page } = this, pixel = (event) => [event.offsetX, event.offsetY];
    const point = (event) => { page.probe = page.view.toMetres(...pixel(event)); page.draw(); page.read(); };
    canvas.addEventListener("pointerdown", (event) => {
      this.pointers.set(event.pointerId, pixel(event));
      canvas.setPointerCapture(event.pointerId);
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      canvas.addEventListener(end, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("pointermove", (event) => {
      if (this.pointers.has(event.pointerId)) this.drag(event.pointerId, pixel(event));
      point(event);
    });
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      this.zoom(FURTHER ** (-Math.sign(event.deltaY)), pixel(event));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.press(event));
  }

  // One pointer moves the map; two hold it, and zoom it as they part.
  drag(id, [x, y]) {
    const [oldX, oldY] = this.pointers.get(id), [other] = [...this.pointers].filter(([one]) => one !== id);
    this.pointers.set(id, [x, y]);
    if (!other) { this.page.view.move(oldX - x, y - oldY); return; }
    const apart = ([atX, atY]) => Math.max(1, Math.hypot(atX - other[1][0], atY - other[1][1]));
    this.page.view.zoom(apart([x, y]) / apart([oldX, oldY]), other[1]);
  }

  press(event) {
    const { page } = this, step = 40;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (moves[event.key]) page.view.move(...moves[event.key]);
    else if (event.key === "+" || event.key === "=") page.view.zoom(FURTHER);
    else if (event.key === "-") page.view.zoom(1 / FURTHER);
    else if (event.key === "0") { part("view").selectedIndex = page.content.views.length; this.look(); }
    else return;
    event.preventDefault();
    page.probe = [...page.view.centre];
    page.draw();
    page.read();
  }
}

// Every map, small: to choose one, and on paper. Each is drawn when it comes into sight; returned is what draws the rest
// at once, and what has all drawn again in other colors.
function fillGallery(page, controls) {
  const all = page.choices.flatMap((quantity, q) => quantity.bands.flatMap((band, b) => band.rigs.map((rig, r) => ({ quantity, band, rig, at: { quantity: q, band: b, rig: r } }))));
  const draws = new Map(), todo = new Set();
  const drawn = (canvas) => { if (todo.delete(canvas)) draws.get(canvas)(); sight.unobserve(canvas); };
  const sight = new IntersectionObserver((entries) => {
    for (const one of entries) if (one.isIntersecting) drawn(one.target);
  }, { rootMargin: "300px" });
  part("gallery").replaceChildren(...all.map(({ quantity, band, rig, at }) => {
    const button = made("button", "", { type: "button" }), figure = made("figure"), canvas = made("canvas");
    const draw = cropped(canvas, page.content.rasters[rig.map.raster], page.content.ego);
    draws.set(canvas, () => draw(page.shown(rig, false).image));
    button.append(canvas, made("figcaption", `${quantity.name}, ${band.name}: ${rig.name}`));
    button.addEventListener("click", () => {
      Object.assign(page.state, at);
      controls.fillMenus();
      page.refresh();
      part("map").scrollIntoView();
    });
    figure.append(button, barOf(rig.against ? rig.map.difference_scale : rig.map.scale, page.content.luts));
    return figure;
  }));
  const again = () => { for (const canvas of draws.keys()) { todo.add(canvas); sight.observe(canvas); } };
  again();
  return { again, rest: () => [...todo].forEach(drawn) };
}

// A canvas as large as what is known of a raster, and what draws an image of all of it there, on hatching.
function cropped(canvas, raster, ego) {
  const { x, y } = raster.observed_bounds;
  const left = Math.round((x[0] - raster.x[0]) / raster.cell_m), top = Math.round((raster.y[1] - y[1]) / raster.cell_m);
  const columns = Math.round((x[1] - x[0]) / raster.cell_m), rows = Math.round((y[1] - y[0]) / raster.cell_m);
  const larger = columns < 700 ? Math.floor(700 / columns) : 700 / columns;
  canvas.width = larger * columns; canvas.height = Math.ceil(larger * rows);
  return (image) => {
    const pen = canvas.getContext("2d");
    pen.fillStyle = hatching(pen);
    pen.fillRect(0, 0, canvas.width, canvas.height);
    pen.imageSmoothingEnabled = larger < 1;
    pen.drawImage(image, left, top, columns, rows, 0, 0, canvas.width, canvas.height);
    const pixel = (low, high) => (larger * (high - low)) / raster.cell_m;
    pen.beginPath();
    for (const corner of ego || []) pen.lineTo(pixel(x[0], corner[0]), pixel(corner[1], y[1]));
    pen.closePath();
    pen.fillStyle = "white"; pen.fill();
    pen.strokeStyle = "black"; pen.stroke();
  };
}

// What is drawn has the colors of the page, dark or light, and those of paper.
function drawAgain(page, gallery) {
  const redraw = () => { gallery.again(); page.draw(); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  window.addEventListener("beforeprint", () => { redraw(); gallery.rest(); });
  window.addEventListener("afterprint", redraw);
}

// Paper is white, and on it nothing can be opened.
function printWhole() {
  let closed = [];
  window.addEventListener("beforeprint", () => {
    document.documentElement.classList.add("on-paper");
    closed = [...document.querySelectorAll("details:not([open])")];
    for (const one of closed) one.open = true;
  });
  window.addEventListener("afterprint", () => {
    document.documentElement.classList.remove("on-paper");
    for (const one of closed) one.open = false;
  });
}

async function start() {
  printWhole();
  const content = JSON.parse(part("content").textContent);
  if (!content.maps.length) return null;
  const bytes = await inflated(part("cells").textContent);
  part("maps").hidden = false;
  const page = new MapPage(content, bytes);
  drawAgain(page, fillGallery(page, new Controls(page)));
  return page;
}

const opened = start();
