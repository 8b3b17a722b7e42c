// Numbered points on the model: sprites of one size on the screen, faint where they are hidden.
import { CanvasTexture, Group, Sprite, SpriteMaterial, SRGBColorSpace, Vector3 } from "three";
import { drawBadge } from "./drawing.js";

const SIZE = 34; // of a sprite on the screen, with room around the badge [px]
const SHARP = 3; // pixels of its picture over those
const TOWARDS = 0.02; // so that the surface does not cut a sprite in half [diagonals]
const HIDDEN_OPACITY = 0.22;

export class Markers {
  constructor(stage) {
    this.stage = stage;
    this.group = new Group();
    stage.scene.add(this.group);
    this.textures = new Map();
    this.shown = [];
  }

  /** Show these, each with kind, label and xyz; says whether that is another picture. */
  show(markers) {
    const key = JSON.stringify(markers);
    if (key === this.key) return false;
    this.key = key;
    this.shown = markers;
    for (const sprite of this.group.children) sprite.material.dispose();
    this.group.clear();
    for (const { kind, label, xyz } of markers) {
      const common = { map: this.texture(kind, label), sizeAttenuation: false, transparent: true, depthWrite: false };
      for (const [depthTest, opacity] of [[false, HIDDEN_OPACITY], [true, 1]]) {
        const sprite = new Sprite(new SpriteMaterial({ ...common, depthTest, opacity }));
        sprite.userData.place = new Vector3(...xyz);
        sprite.renderOrder = kind === "free" ? 1 : 2;
        this.group.add(sprite);
      }
    }
    return true;
  }

  /** Put the sprites a little before the surface and give them their size; before each drawing. */
  face() {
    const { camera, host } = this.stage;
    const size = (SIZE * 2 * Math.tan((camera.fov * Math.PI) / 360)) / Math.max(host.clientHeight, 1);
    for (const sprite of this.group.children) {
      const { place } = sprite.userData;
      const towards = camera.position.clone().sub(place).normalize();
      sprite.position.copy(place).addScaledVector(towards, TOWARDS);
      sprite.scale.setScalar(size);
    }
  }

  texture(kind, label) {
    const key = `${kind} ${label}`;
    if (!this.textures.has(key)) {
      const canvas = new OffscreenCanvas(SIZE * SHARP, SIZE * SHARP);
      const context = canvas.getContext("2d");
      context.scale(SHARP, SHARP);
      drawBadge(context, kind, label, SIZE / 2, SIZE / 2);
      const texture = new CanvasTexture(canvas);
      texture.colorSpace = SRGBColorSpace;
      this.textures.set(key, texture);
    }
    return this.textures.get(key);
  }
}
