// Worker that fetches and decodes a container (load.js).

import { serve } from './load.js';
// indirect imports, listed so that the browser fetches all modules at once
import './assemble.js';
import './band.js';
import './decoder.js';
import './grid.js';
import './head.js';
import './wasm-instance.js';
import './module.js';
import './problem.js';
import './start.js';
import '../draw/border.js';
import '../draw/half-float.js';
import '../draw/instances.js';
import '../draw/deep-stacks.js';
import '../draw/texture-atlas.js';
import '../view/camera.js';
import '../view/camera-limits.js';

serve(self);
