// A glTF model through other people's programs: the validator of its makers, and a renderer.

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
// colours are blended in the photo's own encoding, as tmpi does: nothing is decoded and nothing encoded
model.scene.traverse((o) => o.material && ((o.material.map.colorSpace = THREE.NoColorSpace), (o.material.map.needsUpdate = true)));
const renderer = new THREE.WebGLRenderer({ antialias: false, alpha: true, preserveDrawingBuffer: true });
renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
renderer.setClearColor(0, 0);
document.body.append(renderer.domElement);
window.names = [];
model.scene.traverse((o) => window.names.push(o.name));
window.draw = (pose, width, height) => {
  renderer.setSize(width, height, false);
  const camera = model.cameras[0];
  const degrees = Math.PI / 180;
  camera.position.set(pose.tx ?? 0, -(pose.ty ?? 0), -(pose.tz ?? 0));
  // to the right, up and clockwise are positive in tmpi
  camera.rotation.set((pose.pitch ?? 0) * degrees, -(pose.yaw ?? 0) * degrees, -(pose.roll ?? 0) * degrees, 'YXZ');
  renderer.render(model.scene, camera);
  const gl = renderer.getContext();
  const data = new Uint8Array(width * height * 4);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  let text = '';
  for (let y = height - 1; y >= 0; y--) text += String.fromCharCode(...data.subarray(y * width * 4, (y + 1) * width * 4));
  return btoa(text);
};
window.ready = true;
</script>`;

/** The validator's report: `{errors, warnings, messages}`. */
export async function validate(glb) {
  const { issues } = await validateBytes(new Uint8Array(glb), { maxIssues: 50, writeTimestamp: false });
  return { errors: issues.numErrors, warnings: issues.numWarnings, messages: issues.messages };
}

/** Opens a model in three.js; `draw(pose, width, height)` gives RGBA. */
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
  };
}
