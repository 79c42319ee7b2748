// alpha = opacity exp(-d^2 / 2), at most 0.999, and nothing below 1/255, as in common/raster/tiles.py.
precision highp float;

flat in vec4 colour;
in vec2 offset;
out vec4 premultiplied;

void main() {
  float alpha = min(colour.a * exp(-0.5 * dot(offset, offset)), 0.999);
  if (alpha < 1.0 / 255.0) discard;
  premultiplied = vec4(colour.rgb * alpha, alpha);
}
