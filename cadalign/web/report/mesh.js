// Models of the payload: coordinates quantised to 16 bits, indices of 16 or 32 bits.

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes.buffer;
}

/**
 * Unpack a model.
 *
 * @returns {{vertices: Float32Array, faces: Uint16Array|Uint32Array, edges: Uint16Array|Uint32Array}}
 */
export function unpackMesh({ lo, step, vertices, faces, edges, wide }) {
  const grid = new Uint16Array(bytesOf(vertices));
  const Index = wide ? Uint32Array : Uint16Array;
  return {
    vertices: Float32Array.from(grid, (value, i) => lo[i % 3] + step[i % 3] * value),
    faces: new Index(bytesOf(faces)),
    edges: new Index(bytesOf(edges)),
  };
}

/**
 * Vertices as triples, feature edges as pairs of indices, and the key of their layer: a skeleton,
 * which has no triangles, belongs to the keypoints.
 */
export function wireOf({ vertices, faces, edges }) {
  const points = Array.from({ length: vertices.length / 3 }, (_, i) => [
    vertices[3 * i],
    vertices[3 * i + 1],
    vertices[3 * i + 2],
  ]);
  const pairs = Array.from({ length: edges.length / 2 }, (_, i) => [
    edges[2 * i],
    edges[2 * i + 1],
  ]);
  return { points, edges: pairs, layer: faces.length ? "w" : "k" };
}
