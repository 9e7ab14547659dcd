// Numbers of cells: decode the arrays of torchcover/report/page/map_content.py, merge cells, and color them.

async function inflated(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function decoded(array, bytes, size) {
  const top = 2 ** array.bits - 1;
  const value = (code) => {
    if (code === 0) return 0;
    if (code === top) return Infinity;
    const share = (code - 1) / (top - 2);
    return array.is_logarithmic ? array.low * (array.high / array.low) ** share : array.low + share * (array.high - array.low);
  };
  const table = Float64Array.from({ length: top + 1 }, (_, code) => value(code));
  const values = new Float64Array(size).fill(NaN);
  const low = array.offset + (array.bits === 16 ? array.count : 0);
  for (let cell = 0, at = 0; cell < size; cell++) {
    if (!(bytes[array.mask + (cell >> 3)] & (1 << (cell & 7)))) continue;
    values[cell] = table[bytes[low + at] + (array.bits === 16 ? 256 * bytes[array.offset + at] : 0)];
    at++;
  }
  return values;
}

// The mean over the square that each cell lies in, and its weight; a square is as wide as `sides` says.
function overSquares(values, weights, sides, columns) {
  const means = new Float64Array(values.length).fill(NaN);
  const together = new Float64Array(values.length).fill(NaN);
  const across = columns + 1;
  const sums = new Map();
  const square = (cell) => {
    const side = sides[cell], row = Math.floor(cell / columns), column = cell % columns;
    return (Math.floor(row / side) * side) * across + Math.floor(column / side) * side;
  };
  for (let cell = 0; cell < values.length; cell++) {
    if (Number.isNaN(values[cell])) continue;
    const key = square(cell), sum = sums.get(key);
    if (sum) { sum[0] += weights[cell]; sum[1] += weights[cell] * values[cell]; }
    else sums.set(key, [weights[cell], weights[cell] * values[cell]]);
  }
  for (let cell = 0; cell < values.length; cell++) {
    const sum = sums.get(square(cell));
    if (sum) { means[cell] = sum[1] / sum[0]; together[cell] = sum[0]; }
  }
  return [means, together];
}

const FAINTEST = 0.3, APART = [213, 94, 0];

// Infinity, and nothing at all where the scale is logarithmic, have a color of their own.
const isApart = (value, shown) => (value === Infinity && !shown.isDifference) || (value === 0 && shown.scale.is_logarithmic);

// An image of one pixel a cell, the lowest row last; unobserved cells are transparent.
function colored(shown, palette) {
  const { columns, rows } = shown.raster, image = new ImageData(columns, rows);
  for (let cell = 0; cell < shown.values.length; cell++) {
    const value = shown.values[cell];
    if (Number.isNaN(value)) continue;
    const pixel = 4 * ((rows - 1 - Math.floor(cell / columns)) * columns + (cell % columns));
    image.data.set(isApart(value, shown) ? APART : palette(value), pixel);
    image.data[pixel + 3] = 255 * opacity(shown, cell);
  }
  const canvas = document.createElement("canvas");
  canvas.width = columns; canvas.height = rows;
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}

function opacity(shown, cell) {
  if (!shown.opaqueWeight) return 1;
  const side = shown.squares ? shown.squares[cell] : 1;
  return FAINTEST + (1 - FAINTEST) * Math.sqrt(Math.min(1, shown.weights[cell] / (shown.opaqueWeight * side * side)));
}

// The colors of a scale: from a value to [red, green, blue].
function paletteOf(scale, luts) {
  const lut = luts[scale.colormap], table = [];
  for (let at = 0; at < 256; at++) table.push([0, 2, 4].map((byte) => parseInt(lut.substr(6 * at + byte, 2), 16)));
  return (value) => table[Math.max(0, Math.min(255, Math.floor(256 * shareOf(value, scale))))];
}

// Where a value is between the ends of a scale, and back.
function shareOf(value, { low, high, is_logarithmic }) {
  return is_logarithmic ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
}

function valueAt(share, { low, high, is_logarithmic }) {
  return is_logarithmic ? low * (high / low) ** share : low + share * (high - low);
}
