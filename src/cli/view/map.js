// Maps as pictures: what the server sends, colours, the cross.

/** Takes apart what the server sends: a JSON object and floats behind it. */
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const about = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { about, values: new Float32Array(buffer.slice(4 + length)) };
}

/** The value below which a share of the values lies. */
export function quantile(values, share) {
  const sorted = Float32Array.from(values).sort();
  return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
}

/** The range of inverse depths that colours stand for: from the least to the 95th percentile, as in NAME_disp.png. */
export function range(values) {
  const low = quantile(values, 0), high = quantile(values, 0.95);
  return [low, high > low ? high : low + 1e-9];
}

/** Inverse depth in colours, near is bright. */
export function colours({ about, values }, palette) {
  const image = new ImageData(about.width, about.height);
  const [low, high] = range(values);
  for (let i = 0; i < values.length; i++) {
    const share = Math.max(0, Math.min(1, (values[i] - low) / (high - low)));
    const colour = palette[Math.round(255 * share)];
    image.data.set([colour[0], colour[1], colour[2], 255], 4 * i);
  }
  return image;
}

/** A layer's weights over the picture in grey: red counts for the pixel, blue against it. */
export function overlay(picture, layer, numbers) {
  const { width, height } = picture;
  const image = new ImageData(width, height);
  const most = numbers.reduce((most, x) => Math.max(most, Math.abs(x)), 1e-30);
  for (let y = 0; y < height; y++) {
    const row = Math.floor((y * layer.height) / height);
    for (let x = 0; x < width; x++) {
      const at = 4 * (y * width + x);
      const grey = 0.5 * (0.3 * picture.data[at] + 0.59 * picture.data[at + 1] + 0.11 * picture.data[at + 2]) + 40;
      const weight = numbers[row * layer.width + Math.floor((x * layer.width) / width)] / most;
      const share = Math.sqrt(Math.abs(weight));
      const to = weight > 0 ? [255, 70, 40] : [60, 130, 255];
      for (let c = 0; c < 3; c++) image.data[at + c] = grey + (to[c] - grey) * share;
      image.data[at + 3] = 255;
    }
  }
  return image;
}

/** A cross at a place, in shares of the picture. */
export function cross(context, [x, y]) {
  const { width, height } = context.canvas;
  const [u, v, r] = [x * width, y * height, Math.max(6, width / 90)];
  for (const [colour, thick] of [["#000", 4], ["#fff", 2]]) {
    context.strokeStyle = colour;
    context.lineWidth = (thick * width) / 900 + 0.5;
    context.beginPath();
    context.moveTo(u - r, v);
    context.lineTo(u + r, v);
    context.moveTo(u, v - r);
    context.lineTo(u, v + r);
    context.stroke();
  }
}

/** A depth in words. */
export function words(inverse, unit) {
  const depth = 1 / inverse;
  const digits = depth < 10 ? 2 : depth < 100 ? 1 : 0;
  return unit === "metres" ? depth.toFixed(digits) + " m" : depth.toFixed(digits) + " (no unit)";
}
