// Fetches and decodes a container off the page's thread: what load.js does.

import { serve } from './load.js';
// what that imports, named here so that all of it is fetched at once
import './assemble.js';
import './band.js';
import './decoder.js';
import './grid.js';
import './head.js';
import './instance.js';
import './module.js';
import './problem.js';
import './start.js';
import '../draw/border.js';
import '../draw/half-float.js';
import '../draw/instances.js';
import '../draw/soft-stacks.js';
import '../draw/texture-atlas.js';
import '../view/camera.js';
import '../view/limits.js';

serve(self);
