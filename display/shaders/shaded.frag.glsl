// Colours what the processor's ray caster saw.
#include "camera.glsl"
#include "shade.glsl"
uniform sampler2D seen;

out vec4 colour;

void main() {
    Ray ray = pixel_ray();
    colour = shade(texelFetch(seen, ivec2(gl_FragCoord.xy), 0), normalize(ray.dir * voxel_um));
}
