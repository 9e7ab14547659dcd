// A map in metres on a canvas: x forward to the right, y to the left upwards.

const MARGIN = { left: 52, bottom: 38, top: 8, right: 8 };

function ticks(low, high, most) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((one) => one * power >= rough);
  const first = Math.ceil(low / step);
  return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, at) => (first + at) * step);
}

class MapView {
  constructor(canvas) {
    this.canvas = canvas;
    this.centre = [0, 0];
    this.metres = 0.2; // of a CSS pixel
  }

  get area() {
    const { clientWidth, clientHeight } = this.canvas;
    return { width: clientWidth - MARGIN.left - MARGIN.right, height: clientHeight - MARGIN.top - MARGIN.bottom };
  }

  fit(x, y) {
    const { width, height } = this.area;
    this.centre = [(x[0] + x[1]) / 2, (y[0] + y[1]) / 2];
    this.metres = 1.04 * Math.max((x[1] - x[0]) / width, (y[1] - y[0]) / height);
  }

  toPixel(x, y) {
    const { width, height } = this.area;
    return [
      MARGIN.left + width / 2 + (x - this.centre[0]) / this.metres,
      MARGIN.top + height / 2 - (y - this.centre[1]) / this.metres,
    ];
  }

  toMetres(pixelX, pixelY) {
    const { width, height } = this.area;
    return [
      this.centre[0] + (pixelX - MARGIN.left - width / 2) * this.metres,
      this.centre[1] - (pixelY - MARGIN.top - height / 2) * this.metres,
    ];
  }

  zoom(factor, pixel) {
    const { width, height } = this.area;
    const [x, y] = pixel || [MARGIN.left + width / 2, MARGIN.top + height / 2];
    const before = this.toMetres(x, y);
    this.metres = Math.min(5, Math.max(0.0005, this.metres / factor));
    const after = this.toMetres(x, y);
    this.centre = [this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]];
  }

  move(right, up) {
    this.centre = [this.centre[0] + right * this.metres, this.centre[1] + up * this.metres];
  }

  draw(shown, scene) {
    const { canvas } = this, ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    const pen = canvas.getContext("2d"), { width, height } = this.area;
    pen.scale(ratio, ratio);
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left, MARGIN.top, width, height);
    pen.clip();
    this.drawCells(pen, shown);
    for (const line of scene.lines) this.drawLine(pen, line);
    if (scene.ego) this.drawEgo(pen, scene.ego);
    for (const [at, sensor] of scene.sensors.entries()) this.drawSensor(pen, sensor, at + 1, scene.fields);
    if (scene.probe) this.drawProbe(pen, scene.probe, shown.raster);
    pen.restore();
    this.drawAxes(pen, width, height);
  }

  drawCells(pen, shown) {
    const { x, y } = shown.raster, [left, top] = this.toPixel(x[0], y[1]), [right, bottom] = this.toPixel(x[1], y[0]);
    pen.fillStyle = hatching(pen);
    pen.fillRect(left, top, right - left, bottom - top);
    pen.imageSmoothingEnabled = shown.raster.cell_m / this.metres < 1;
    pen.imageSmoothingQuality = "high";
    pen.drawImage(shown.image, left, top, right - left, bottom - top);
    pen.imageSmoothingEnabled = true;
  }

  path(pen, points) {
    let pending = true;
    pen.beginPath();
    for (const [x, y] of points) {
      if (x === null) { pending = true; continue; }
      pen[pending ? "moveTo" : "lineTo"](...this.toPixel(x, y));
      pending = false;
    }
  }

  drawLine(pen, line) {
    this.path(pen, line.closed ? [...line.points, line.points[0]] : line.points);
    pen.lineJoin = "round";
    pen.strokeStyle = "white"; pen.lineWidth = line.width + 2; pen.setLineDash([]); pen.stroke();
    pen.strokeStyle = "black"; pen.lineWidth = line.width; pen.setLineDash(line.dash); pen.stroke();
    pen.setLineDash([]);
  }

  drawEgo(pen, outline) {
    this.path(pen, [...outline, outline[0]]);
    pen.fillStyle = "white"; pen.fill();
    pen.strokeStyle = "black"; pen.lineWidth = 1.2; pen.stroke();
  }

  drawSensor(pen, sensor, number, fields) {
    const [x, y] = this.toPixel(sensor.x, sensor.y);
    if (fields) {
      this.pathOfField(pen, sensor);
      pen.strokeStyle = "white"; pen.lineWidth = 3; pen.stroke();
      pen.strokeStyle = "black"; pen.lineWidth = 1; pen.setLineDash([6, 4]); pen.stroke(); pen.setLineDash([]);
    }
    pen.beginPath();
    pen.arc(x, y, 3.5, 0, 2 * Math.PI);
    pen.fillStyle = "black"; pen.fill();
    pen.strokeStyle = "white"; pen.lineWidth = 1; pen.stroke();
    if (this.metres > 0.05) return; // from so far they lie on each other
    pen.font = "11px sans-serif"; pen.textAlign = "left"; pen.textBaseline = "middle";
    pen.strokeStyle = "white"; pen.lineWidth = 3; pen.strokeText(String(number), x + 6, y);
    pen.fillStyle = "black"; pen.fillText(String(number), x + 6, y);
  }

  // The field of view from above: the outline of a tilted sensor, otherwise an arc.
  pathOfField(pen, sensor) {
    if (sensor.outline) return this.path(pen, [...sensor.outline, sensor.outline[0]]);
    const [x, y] = this.toPixel(sensor.x, sensor.y), yaw = (sensor.yaw_deg * Math.PI) / 180;
    const half = (sensor.horizontal_fov_deg * Math.PI) / 360;
    pen.beginPath();
    if (sensor.horizontal_fov_deg < 360) pen.moveTo(x, y);
    pen.arc(x, y, sensor.range_m / this.metres, -yaw - half, -yaw + half);
    if (sensor.horizontal_fov_deg < 360) pen.closePath();
  }

  drawProbe(pen, [x, y], raster) {
    const low = (value, bounds) => bounds[0] + Math.floor((value - bounds[0]) / raster.cell_m) * raster.cell_m;
    const [left, bottom] = this.toPixel(low(x, raster.x), low(y, raster.y)), size = raster.cell_m / this.metres;
    const grown = Math.max(size, 5), shift = (grown - size) / 2;
    pen.strokeStyle = "white"; pen.lineWidth = 3.5; pen.strokeRect(left - shift, bottom - size - shift, grown, grown);
    pen.strokeStyle = "black"; pen.lineWidth = 1.5; pen.strokeRect(left - shift, bottom - size - shift, grown, grown);
  }

  drawAxes(pen, width, height) {
    const [left, top] = this.toMetres(MARGIN.left, MARGIN.top);
    const [right, bottom] = this.toMetres(MARGIN.left + width, MARGIN.top + height);
    const words = (value) => String(+value.toPrecision(6)).replace("-", "−");
    pen.strokeStyle = pen.fillStyle = getComputedStyle(this.canvas).color; pen.lineWidth = 1; pen.font = "12px sans-serif";
    pen.strokeRect(MARGIN.left, MARGIN.top, width, height);
    pen.textAlign = "center"; pen.textBaseline = "top";
    for (const value of ticks(left, right, width / 80)) {
      const [at] = this.toPixel(value, 0), end = MARGIN.top + height;
      pen.beginPath(); pen.moveTo(at, end); pen.lineTo(at, end + 4); pen.stroke();
      pen.fillText(words(value), at, end + 6);
    }
    pen.fillText("x forward (m)", MARGIN.left + width / 2, MARGIN.top + height + 21);
    pen.textAlign = "right"; pen.textBaseline = "middle";
    for (const value of ticks(bottom, top, height / 50)) {
      const [, at] = this.toPixel(0, value);
      pen.beginPath(); pen.moveTo(MARGIN.left - 4, at); pen.lineTo(MARGIN.left, at); pen.stroke();
      pen.fillText(words(value), MARGIN.left - 6, at);
    }
    pen.save();
    pen.translate(12, MARGIN.top + height / 2); pen.rotate(-Math.PI / 2);
    pen.textAlign = "center"; pen.fillText("y left (m)", 0, 0);
    pen.restore();
  }
}

// Unobserved cells are hatched gray, which is no color of any scale.
function hatching(pen) {
  const tile = document.createElement("canvas"), style = getComputedStyle(pen.canvas);
  tile.width = tile.height = 8;
  const own = tile.getContext("2d");
  own.fillStyle = style.getPropertyValue("--unobserved"); own.fillRect(0, 0, 8, 8);
  own.strokeStyle = style.getPropertyValue("--hatch"); own.lineWidth = 1;
  own.beginPath();
  for (const shift of [-8, 0, 8]) { own.moveTo(shift, 8); own.lineTo(shift + 8, 0); }
  own.stroke();
  return pen.createPattern(tile, "repeat");
}
