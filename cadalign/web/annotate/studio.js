// The light of `cadalign render` as a material: key, fill, sky and ground, which stand still
// relative to the camera. See render/raycast/shading.py, whose numbers these are.
import { NormalBlending, ShaderMaterial } from "three";

const VERTEX = `
attribute vec4 tint;
attribute float doubled;
varying vec4 vTint;
varying vec3 vNormal;
varying vec3 vPlace;
varying vec3 vUp;
varying float vDoubled;
void main() {
  vec4 place = modelViewMatrix * vec4(position, 1.0);
  vTint = tint;
  vNormal = normalMatrix * normal;
  vPlace = place.xyz;
  vUp = mat3(viewMatrix) * vec3(0.0, 1.0, 0.0);
  vDoubled = doubled;
  gl_Position = projectionMatrix * place;
}`;

// Directions are those of a camera whose y points up and which looks along -z.
const FRAGMENT = `
varying vec4 vTint;
varying vec3 vNormal;
varying vec3 vPlace;
varying vec3 vUp;
varying float vDoubled;
const vec3 KEY = normalize(vec3(-0.55, 0.75, 0.75));
const vec3 FILL = normalize(vec3(0.9, 0.15, 0.6));
float diffuse(float cosine) { return max((cosine + 0.25) / 1.25, 0.0); }
void main() {
  // Another triangle lies in its place, and shows this side.
  if (vDoubled > 0.5 && !gl_FrontFacing) discard;
  vec3 view = normalize(-vPlace);
  vec3 normal = length(vNormal) > 1e-6 ? normalize(vNormal) : view;
  vec3 flat_ = normalize(cross(dFdx(vPlace), dFdy(vPlace)));
  // Triangles of real models face either way: what is seen is lit.
  if (dot(flat_, view) < 0.0) flat_ = -flat_;
  if (dot(normal, flat_) < 0.0) normal = -normal;
  float light = 0.08 + 0.20 * (0.5 + 0.5 * dot(normal, normalize(vUp)))
    + 0.60 * diffuse(dot(normal, KEY)) + 0.12 * diffuse(dot(normal, FILL));
  float shine = 0.08 * pow(max(dot(normal, normalize(view + KEY)), 0.0), 40.0);
  vec3 lifted = 0.015 + 0.985 * vTint.rgb;
  gl_FragColor = vec4(lifted * light + shine, vTint.a);
  #include <colorspace_fragment>
}`;

/** The material; of transparent triangles those behind are seen through them. */
export function studioMaterial({ transparent }) {
  return new ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    side: 2, // both
    transparent,
    depthWrite: !transparent,
    blending: NormalBlending,
    polygonOffset: true, // so that lines on the surface are not cut
    polygonOffsetFactor: 1,
    polygonOffsetUnits: 1,
  });
}
