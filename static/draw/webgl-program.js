// Builds WebGL2 programs without blocking on the graphics process, if the browser compiles in parallel.

/** Interval of polling whether a program is built, ms. */
const POLL_MS = 4;

/** @typedef {{program: WebGLProgram, shaders: WebGLShader[]}} Begun */

/**
 * Starts to build a program. It queries nothing, because every query would block on the graphics process.
 * @param {WebGL2RenderingContext} gl
 * @param {string} vertex
 * @param {string} fragment
 * @returns {Begun}
 */
export function begin(gl, vertex, fragment) {
  const program = gl.createProgram();
  /** @type {WebGLShader[]} */
  const shaders = [];
  const add = (/** @type {GLenum} */ type, /** @type {string} */ source) => {
    const shader = gl.createShader(type);
    // null only if the context is lost
    if (!shader) return;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    shaders.push(shader);
  };
  add(gl.VERTEX_SHADER, vertex);
  add(gl.FRAGMENT_SHADER, fragment);
  gl.linkProgram(program);
  return { program, shaders };
}

/**
 * Resolves with the program once it is built; throws the compiler's message.
 * @param {WebGL2RenderingContext} gl
 * @param {Begun} begun
 */
export async function built(gl, { program, shaders }) {
  const parallel = gl.getExtension('KHR_parallel_shader_compile');
  while (parallel && gl.getProgramParameter(program, parallel.COMPLETION_STATUS_KHR) === false) {
    await new Promise((resume) => setTimeout(resume, POLL_MS));
  }
  if (gl.getProgramParameter(program, gl.LINK_STATUS)) return program;
  const logs = [...shaders.map((shader) => gl.getShaderInfoLog(shader)), gl.getProgramInfoLog(program)];
  throw new Error(logs.find(Boolean) || 'the shader cannot be built');
}
