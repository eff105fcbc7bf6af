// One ray loop for all modes: the snippet says what to do with each sample.
#include "camera.glsl"
#include "volume.glsl"
#include "shade.glsl"
uniform float step_um;
#include "snippet.glsl"

out vec4 colour;

void main() {
    Ray ray = pixel_ray();
    vec2 span = box_span(ray, low, high);
    vec4 seen = nothing();
    if (span.y > span.x) {
        int count = int(ceil((span.y - span.x) / step_um));
        float ds = (span.y - span.x) / float(count);  // equal steps that end where the volume ends
        begin(ray);
        for (int k = 0; k < count; ++k) {
            float t = span.x + (float(k) + 0.5) * ds;
            if (visit(ray, t, ds)) break;
        }
        seen = end(ray);
    }
    colour = shade(seen, normalize(ray.dir * voxel_um));
}
