// What is changed of the engine's shaders.

// Draws, in place of colours, by uDepths.w: 0 the colours; 1 in each channel what is nearer along the view than one of
// the depths; 2 of what is between the first two, where it is between them, and how much it is.
export const DEPTH = `
uniform vec4 uDepths;
void modifySplatColor(vec2 gaussianUV, inout vec4 color) {
  float depth = 1.0 / gl_FragCoord.w;
  if (uDepths.w == 1.0) color.rgb = step(vec3(depth), uDepths.xyz);
  if (uDepths.w == 2.0) {
    float place = (depth - uDepths.x) / (uDepths.y - uDepths.x);
    color.rgb = place >= 0.0 && place <= 1.0 ? vec3(place, 1.0, 0.0) : vec3(0.0);
  }
}
`;

// Leaves out what is not in [0, 1] by uKept, which is zero for all of the model, and by uLimits what is fainter than the
// first or larger than the second, which is zero for any size.
export const KEPT = `
uniform mat4 uKept;
uniform vec2 uLimits;
float longest;
void modifySplatCenter(inout vec3 center) {}
void modifySplatRotationScale(vec3 original, vec3 center, inout vec4 rotation, inout vec3 scale) {
  longest = max(scale.x, max(scale.y, scale.z));
}
void modifySplatColor(vec3 center, inout vec4 color) {
  vec3 place = (uKept * vec4(center, 1.0)).xyz;
  if (any(lessThan(place, vec3(0.0))) || any(greaterThan(place, vec3(1.0)))) color.a = 0.0;
  if (color.a < uLimits.x || (uLimits.y > 0.0 && longest > uLimits.y)) color.a = 0.0;
}
`;
export const ALL = new Float32Array(16);
