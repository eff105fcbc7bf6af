// Colours what the processor saw of planes.
#include "camera.glsl"
#include "shade.glsl"
uniform sampler2D seen;
uniform vec3 tints[PLANES];

out vec4 colour;

void main() {
    vec4 found = texelFetch(seen, ivec2(gl_FragCoord.xy), 0);
    colour = found.z > 0.0 ? vec4(table_colour(found.x) * tints[int(found.w + 0.5)], 1.0) : vec4(0.0);
}
