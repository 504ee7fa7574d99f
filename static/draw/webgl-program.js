// Builds programs of WebGL2, without waiting for the graphics process where the browser builds them beside the page.

/** Time between two looks at whether a program is built, ms. */
const POLL_MS = 4;

/** @typedef {{program: WebGLProgram, shaders: WebGLShader[]}} Begun */

/**
 * Begins to build a program of a vertex and a fragment shader; nothing is asked, as each answer would wait for the graphics process.
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
    // only a lost context has none
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
 * The program once it is built; throws what the compiler says.
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
