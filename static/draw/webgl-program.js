// Builds programs of WebGL2.

/**
 * A program of a vertex and a fragment shader; throws what the compiler says.
 * @param {WebGL2RenderingContext} gl
 * @param {string} vertex
 * @param {string} fragment
 */
export function program(gl, vertex, fragment) {
  const out = gl.createProgram();
  const add = (/** @type {GLenum} */ type, /** @type {string} */ source) => {
    const shader = gl.createShader(type);
    // only a lost context has none
    if (!shader) return;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader) ?? undefined);
    gl.attachShader(out, shader);
  };
  add(gl.VERTEX_SHADER, vertex);
  add(gl.FRAGMENT_SHADER, fragment);
  gl.linkProgram(out);
  if (!gl.getProgramParameter(out, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(out) || 'the shader cannot be built');
  return out;
}
