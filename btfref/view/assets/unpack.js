// Tables from the page: base64 of deflated bytes, the planes of their bytes one after the other.
const TYPES = { float16: Uint16Array, float32: Float32Array, uint32: Uint32Array, uint8: Uint8Array };

async function unpacked({ blob, type }) {
  if (!globalThis.DecompressionStream) throw new Error("This browser is too old for the page: it cannot unpack the tables.");
  const element = document.getElementById(blob);
  const text = atob(element.textContent);
  element.remove(); // it is as large as the table
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const size = TYPES[type].BYTES_PER_ELEMENT, count = planes.length / size;
  const bytes = new Uint8Array(planes.length);
  for (let plane = 0; plane < size; plane++)
    for (let i = 0; i < count; i++) bytes[i * size + plane] = planes[plane * count + i];
  return new TYPES[type](bytes.buffer);
}
