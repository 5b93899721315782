/** Whether pictures are made by the processor, for which smooth edges and round shapes cost too much. */
export const IS_SOFTWARE = findOut();

function findOut() {
  const probe = document.createElement('canvas').getContext('webgl2');
  const about = probe?.getExtension('WEBGL_debug_renderer_info');
  const name = about ? probe.getParameter(about.UNMASKED_RENDERER_WEBGL) : '';
  probe?.getExtension('WEBGL_lose_context')?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}
