// Numbered points on the model: sprites of one size on the screen, faint where they are hidden.
import { CanvasTexture, Group, Sprite, SpriteMaterial, SRGBColorSpace, Vector3 } from "three";
import { drawBadge } from "./marker.js";

const SIZE = 34; // of a sprite on the screen, with room around the badge [px]
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
    for (const marker of markers) {
      const map = this.texture(marker.kind, marker.label);
      const common = { map, sizeAttenuation: false, transparent: true, depthWrite: false };
      for (const [depthTest, opacity] of [[false, HIDDEN_OPACITY], [true, 1]]) {
        const sprite = new Sprite(new SpriteMaterial({ ...common, depthTest, opacity }));
        sprite.userData = { place: new Vector3(...marker.xyz), marker };
        sprite.renderOrder = marker.kind === "free" ? 1 : 2;
        this.group.add(sprite);
      }
    }
    return true;
  }

  /** Draw the marker of a pair elsewhere while it is dragged; all are put back without a place. */
  moveTo(pair, xyz) {
    for (const { userData } of this.group.children) {
      const { marker, place } = userData;
      place.set(...(xyz && marker.pair === pair ? xyz : marker.xyz));
    }
  }

  /** Put the sprites a little before the surface and give them their size; before each drawing. */
  face() {
    const { camera, host } = this.stage;
    const size = (SIZE * 2 * Math.tan((camera.fov * Math.PI) / 360)) / Math.max(host.clientHeight, 1);
    for (const sprite of this.group.children) {
      const { place } = sprite.userData;
      const towards = camera.position.clone().sub(place);
      sprite.position.copy(place).addScaledVector(towards.normalize(), TOWARDS);
      sprite.scale.setScalar(size);
    }
  }

  texture(kind, label) {
    const key = `${kind} ${label}`;
    if (!this.textures.has(key)) {
      const ratio = 3;
      const canvas = document.createElement("canvas");
      canvas.width = canvas.height = SIZE * ratio;
      const context = canvas.getContext("2d");
      context.scale(ratio, ratio);
      if (kind === "suggested") context.setLineDash([4, 3]);
      drawBadge(context, kind, label, SIZE / 2, SIZE / 2);
      const texture = new CanvasTexture(canvas);
      texture.colorSpace = SRGBColorSpace;
      this.textures.set(key, texture);
    }
    return this.textures.get(key);
  }
}
