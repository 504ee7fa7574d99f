// Opens a glTF model in other programs: Khronos' validator and three.js.

import { readFile } from 'node:fs/promises';
import { createRequire } from 'node:module';
import { validateBytes } from 'gltf-validator';

const three = createRequire(import.meta.url)
  .resolve('three')
  .replace(/build\/[^/]*$/, '');
const HOST = 'http://model.test';

const PAGE = `<!doctype html><script type="importmap">
  { "imports": { "three": "${HOST}/three/build/three.module.js", "three/addons/": "${HOST}/three/examples/jsm/" } }
</script><script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
const model = await new GLTFLoader().loadAsync('${HOST}/model.glb');
// blend colours in the photo's encoding, as tmpi does, without conversion
model.scene.traverse((o) => o.material && ((o.material.map.colorSpace = THREE.NoColorSpace), (o.material.map.needsUpdate = true)));
const renderer = new THREE.WebGLRenderer({ antialias: false, alpha: true, preserveDrawingBuffer: true });
renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
renderer.setClearColor(0, 0);
document.body.append(renderer.domElement);
window.names = [];
model.scene.traverse((o) => window.names.push(o.name));
const { disparity, intrinsics, photo } = model.scene.userData;
window.draw = (pose, width, height) => {
  const camera = model.cameras[0];
  const degrees = Math.PI / 180;
  camera.updateProjectionMatrix();
  // a step in model space with the parallax of one in the photo's space, and the shift of the whole picture, in half views
  const focal = camera.projectionMatrix.elements;
  const step = ((intrinsics.fx / photo.width) * 2) / (focal[0] * disparity.gain);
  const [tx, ty, tz] = [(pose.tx ?? 0) * step, -(pose.ty ?? 0) * step, -(pose.tz ?? 0) * step];
  camera.position.set(tx, ty, tz);
  focal[8] -= focal[0] * tx * disparity.offset;
  focal[9] -= focal[5] * ty * disparity.offset;
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  // in tmpi, right, up and clockwise are positive
  camera.rotation.set((pose.pitch ?? 0) * degrees, -(pose.yaw ?? 0) * degrees, -(pose.roll ?? 0) * degrees, 'YXZ');
  return pixels(camera, width, height);
};
// frames the model by its bounding box, as model-viewer does: from the front, above by some degrees
window.frame = (above, width, height) => {
  const box = new THREE.Box3().setFromObject(model.scene);
  const { center, radius } = box.getBoundingSphere(new THREE.Sphere());
  const camera = new THREE.PerspectiveCamera(30, width / height, radius / 100, radius * 100);
  const distance = (1.05 * radius) / Math.sin((15 * Math.PI) / 180);
  const angle = (above * Math.PI) / 180;
  camera.position.set(0, Math.sin(angle), Math.cos(angle)).multiplyScalar(distance).add(center);
  camera.lookAt(center);
  return { size: box.getSize(new THREE.Vector3()).toArray(), pixels: pixels(camera, width, height) };
};
function pixels(camera, width, height) {
  renderer.setSize(width, height, false);
  renderer.render(model.scene, camera);
  const gl = renderer.getContext();
  const data = new Uint8Array(width * height * 4);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  let text = '';
  for (let y = height - 1; y >= 0; y--) text += String.fromCharCode(...data.subarray(y * width * 4, (y + 1) * width * 4));
  return btoa(text);
}
window.ready = true;
</script>`;

/** Validates a model: `{errors, warnings, messages}`. */
export async function validate(glb) {
  const { issues } = await validateBytes(new Uint8Array(glb), { maxIssues: 50, writeTimestamp: false });
  return { errors: issues.numErrors, warnings: issues.numWarnings, messages: issues.messages };
}

/**
 * Opens a model in three.js. `draw(pose, width, height)` returns RGBA from the photo's camera; `frame(above, width, height)` returns the model's size
 * and RGBA as a viewer that frames the bounding box shows it.
 */
export async function openModel(page, glb) {
  await page.route(`${HOST}/**`, async (route) => {
    const path = new URL(route.request().url()).pathname;
    if (path === '/') return route.fulfill({ contentType: 'text/html', body: PAGE });
    if (path === '/model.glb') return route.fulfill({ contentType: 'model/gltf-binary', body: Buffer.from(glb) });
    return route.fulfill({ contentType: 'text/javascript', body: await readFile(path.replace('/three/', three)) });
  });
  await page.goto(`${HOST}/`);
  await page.waitForFunction(() => window.ready);
  return {
    names: await page.evaluate(() => window.names),
    draw: async (pose, width, height) => {
      const text = await page.evaluate(([p, w, h]) => window.draw(p, w, h), [pose, width, height]);
      return new Uint8ClampedArray(Buffer.from(text, 'base64'));
    },
    frame: async (above, width, height) => {
      const { size, pixels } = await page.evaluate(([a, w, h]) => window.frame(a, w, h), [above, width, height]);
      return { size, pixels: new Uint8ClampedArray(Buffer.from(pixels, 'base64')) };
    },
  };
}
