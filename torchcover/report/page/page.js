// The page: menus, what they choose, and what a cell says. All words go in as text, never as markup.

// Of arrays that are decoded and of maps that are drawn: what was not asked for longest is forgotten first.
const MOST_BYTES = 128e6;

class Kept {
  constructor() { Object.assign(this, { values: new Map(), bytes: 0 }); }

  get(key, make, bytesOf) {
    const found = this.values.get(key) || { value: make() };
    found.bytes ??= bytesOf(found.value);
    if (!this.values.delete(key)) this.bytes += found.bytes;
    this.values.set(key, found);
    for (const [oldest, { bytes }] of this.values) {
      if (this.bytes <= MOST_BYTES || oldest === key) break;
      this.values.delete(oldest);
      this.bytes -= bytes;
    }
    return found.value;
  }
}

const part = (id) => document.getElementById(id);

function made(tag, text, attributes = {}) {
  const node = document.createElement(tag);
  if (text) node.textContent = text;
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}

class MapPage {
  constructor(content, bytes) {
    Object.assign(this, { content, bytes, decoded: new Kept(), kept: new Kept(), highs: new Map() });
    this.view = new MapView(part("map"));
    this.state = { quantity: 0, band: 0, rig: 0, single: false, fields: false };
    this.probe = null;
    this.choices = this.listed();
  }

  // What the menus offer: quantities, then the bands of one, then the rigs of both, and differences behind them.
  listed() {
    const quantities = new Map();
    for (const map of this.content.maps) {
      if (!quantities.has(map.quantity)) quantities.set(map.quantity, new Map());
      const bands = quantities.get(map.quantity);
      if (!bands.has(map.band)) bands.set(map.band, []);
      bands.get(map.band).push({ name: map.rig, map });
    }
    for (const bands of quantities.values()) {
      for (const rigs of bands.values()) {
        const [first, ...others] = rigs;
        for (const { name, map } of others) {
          if (map.difference_scale) rigs.push({ name: `${name} minus ${first.name}`, map, against: first.map });
        }
      }
    }
    return [...quantities].map(([name, bands]) => ({
      name, bands: [...bands].map(([band, rigs]) => ({ name: band, rigs })),
    }));
  }

  get quantity() { return this.choices[this.state.quantity]; }
  get band() { return this.quantity.bands[this.state.band]; }
  get choice() { return this.band.rigs[this.state.rig]; }

  numbers(index, raster) {
    if (index === null) return null;
    const size = raster.columns * raster.rows;
    return this.decoded.get(index, () => decoded(this.content.arrays[index], this.bytes, size), (values) => values.byteLength);
  }

  // The cells of a map, or of a difference, as they are drawn: values, weights, their image.
  // Its colors are those of the place that is looked at where `high` is given, else those of all maps.
  shown(choice, single, high = null) {
    const key = `${single} ${this.content.maps.indexOf(choice.map)} ${Boolean(choice.against)} ${high}`;
    return this.kept.get(key, () => this.made(choice, single, high), ({ values }) => 3 * values.byteLength);
  }

  made(choice, single, high) {
    const { map, against } = choice, raster = this.content.rasters[map.raster];
    let values = this.numbers(map.values, raster), weights = this.numbers(map.weights, raster);
    const squares = single ? null : this.numbers(map.sides, raster);
    const other = against ? this.numbers(against.values, raster) : null;
    let expected = other;
    if (squares) {
      if (other) [expected] = overSquares(other, weights, squares, raster.columns);
      [values, weights] = overSquares(values, weights, squares, raster.columns);
    }
    if (against) values = values.map((value, cell) => (value === expected[cell] ? 0 : value - expected[cell]));
    const scale = { ...(against ? map.difference_scale : map.scale) };
    if (high !== null) { scale.high = high; scale.low = against ? -high : scale.low; }
    const shown = { raster, values, weights, squares, opaqueWeight: map.opaque_weight, isDifference: Boolean(against), scale };
    shown.image = colored(shown, paletteOf(scale, this.content.luts));
    return shown;
  }

  // What is looked at now: lengths in the colors of this place, the same for all bands and rigs.
  get now() {
    return this.shown(this.choice, this.state.single, this.highs.get(this.isOf(this.choice)) ?? null);
  }

  isOf(choice) { return `${this.quantity.name} ${Boolean(choice.against)}`; }

  fitColors() {
    const [left, top] = this.view.toMetres(MARGIN.left, MARGIN.top);
    const { width, height } = this.view.area;
    const [right, bottom] = this.view.toMetres(MARGIN.left + width, MARGIN.top + height);
    const found = new Map();
    for (const choice of this.quantity.bands.flatMap((band) => band.rigs)) {
      if (choice.map.scale.unit !== "m") continue;
      const { raster, values } = this.shown(choice, false), sizes = found.get(this.isOf(choice)) || [];
      found.set(this.isOf(choice), sizes);
      for (let cell = 0; cell < values.length; cell++) {
        const x = raster.x[0] + ((cell % raster.columns) + 0.5) * raster.cell_m;
        const y = raster.y[0] + (Math.floor(cell / raster.columns) + 0.5) * raster.cell_m;
        if (x > left && x < right && y > bottom && y < top && Number.isFinite(values[cell])) sizes.push(Math.abs(values[cell]));
      }
    }
    for (const [of, sizes] of found) {
      sizes.sort((a, b) => a - b);
      const high = sizes[Math.floor(0.98 * (sizes.length - 1))];
      if (high > 0) this.highs.set(of, +high.toPrecision(2));
    }
  }

  draw() {
    const { choice } = this, shown = this.now;
    const rig = this.content.rigs.find((one) => one.name === choice.map.rig);
    const outlines = this.content.outlines.map((line) => ({ ...line, closed: true, width: 1.3, dash: [3, 5] }));
    const lines = choice.map.lines.map((line, at) => ({ ...line, closed: false, width: 2, dash: at ? [9, 3 * at] : [] }));
    this.view.draw(shown, {
      lines: [...outlines, ...lines], ego: this.content.ego, fields: this.state.fields,
      sensors: rig && !choice.against ? rig.sensors : [], probe: this.probe,
    });
    part("map").setAttribute("aria-label", `${this.quantity.name}, ${this.band.name}, ${choice.name}`);
  }

  refresh() {
    const shown = this.now;
    part("bar").replaceChildren(barOf(shown.scale, this.content.luts));
    this.fillLegend(shown);
    this.draw();
    this.read();
  }

  fillLegend(shown) {
    const { map, against } = this.choice, entries = [`hatched: ${map.unobserved_label}`];
    if (shown.values.includes(Infinity) && !against) entries.push("orange: infinite, a step saw nothing");
    if (shown.scale.is_logarithmic && shown.values.includes(0)) entries.push("orange: none");
    if (against) entries.push(`blue: ${this.choice.map.rig} is better; red: ${against.rig} is better`);
    if (shown.squares) entries.push(`squares are larger where points are few`);
    if (shown.opaqueWeight) entries.push("paler: less visible surface per frame than open ground");
    if (this.content.outlines.length) entries.push(`dotted: ${this.content.outlines.map((line) => line.name).join(", ")}`);
    for (const [at, line] of map.lines.entries()) entries.push(`${at ? "dashed" : "thick"} line: ${line.name}`);
    part("legend").replaceChildren(...entries.map((words) => made("li", words)));
  }

  // What the cell says that is pointed at.
  read() {
    part("readout").textContent = this.probe ? this.words(...this.probe) : "";
  }

  words(x, y) {
    const { map, against } = this.choice, raster = this.content.rasters[map.raster];
    const column = Math.floor((x - raster.x[0]) / raster.cell_m), row = Math.floor((y - raster.y[0]) / raster.cell_m);
    const place = (low, at) => `${tidy(low + at * raster.cell_m)} to ${tidy(low + (at + 1) * raster.cell_m)} m`;
    const where = `x ${place(raster.x[0], column)}, y ${place(raster.y[0], row)}`;
    if (column < 0 || row < 0 || column >= raster.columns || row >= raster.rows) return `${where}: beyond the grid`;
    const cell = row * raster.columns + column, unit = map.scale.unit;
    const one = (own) => said(this.numbers(own.values, raster)[cell], this.error(own, raster, cell), unit, own.unobserved_label);
    const parts = [`${where}: ${one(map)}`];
    if (against) {
      const value = this.numbers(map.values, raster)[cell], expected = this.numbers(against.values, raster)[cell];
      const error = Math.hypot(this.error(map, raster, cell), this.error(against, raster, cell));
      const difference = value === expected ? 0 : value - expected;
      parts[0] = `${where}: difference ${said(difference, error, map.difference_scale.unit, map.unobserved_label, -Infinity)} (as if independent)`;
      parts.push(`${map.rig} ${one(map)}`, `${against.rig} ${one(against)}`);
    }
    const weights = this.numbers(map.weights, raster);
    if (weights && !Number.isNaN(weights[cell])) parts.push(`${map.weight_name}: ${figures(weights[cell])}`);
    const shown = this.now;
    if (shown.squares && shown.squares[cell] > 1 && !Number.isNaN(shown.values[cell])) {
      parts.push(`its square of ${tidy(shown.squares[cell] * raster.cell_m)} m: ${figures(shown.values[cell])} ${unit}`);
    }
    return parts.join("; ");
  }

  error(map, raster, cell) {
    const errors = this.numbers(map.errors, raster);
    return errors ? errors[cell] : NaN;
  }
}

// Four digits that count, or as many as there are before the point.
const figures = (value) => (value === Infinity ? "infinite" : tidy(+value.toPrecision(4)));
const tidy = (value) => String(+value.toFixed(6)).replace("-", "−");

// A number, and two standard errors to either side within its range.
function said(value, error, unit, unobservedLabel, least = 0, most = unit === "%" ? 100 : Infinity) {
  if (Number.isNaN(value)) return unobservedLabel;
  const end = (times) => figures(Math.min(Math.max(value + times * error, least), most));
  return `${figures(value)}${Number.isNaN(error) ? "" : ` [${end(-2)}, ${end(2)}]`} ${unit}`;
}

function barOf(scale, luts) {
  const bar = made("div", "", { class: "bar" });
  const canvas = made("canvas", "", { width: 256, height: 1, "aria-hidden": "true" });
  const palette = paletteOf(scale, luts), pen = canvas.getContext("2d");
  for (let at = 0; at < 256; at++) {
    pen.fillStyle = `rgb(${palette(valueAt((at + 0.5) / 256, scale))})`;
    pen.fillRect(at, 0, 1, 1);
  }
  const marks = made("div", "", { class: "ticks" });
  for (let at = 0; at <= 4; at++) marks.append(made("span", tidy(+valueAt(at / 4, scale).toPrecision(3))));
  bar.append(made("div", `${scale.quantity} (${scale.unit})`), canvas, marks);
  return bar;
}
