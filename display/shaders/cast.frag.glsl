// One ray loop for all modes: the snippet says what to do with each sample.
#include "camera.glsl"
#include "volume.glsl"
#include "shade.glsl"
uniform float step_um, fade_per_um, front_um, surface;
uniform bool from_behind;
#include "snippet.glsl"

out vec4 colour;

void main() {
    Ray ray = pixel_ray();
    vec2 span = box_span(ray, low, high);
    vec4 seen = nothing();
    if (span.y > span.x) {
        int count = int(ceil((span.y - span.x) / step_um));
        float ds = (span.y - span.x) / float(count);  // equal steps that end where the volume ends
        begin(ray, span);
#ifdef EXACT
        for (float t = span.x; t < span.y - 1e-6 * step_um;) {  // from wall to wall of voxels
            float end = min(voxel_exit(ray, t), span.y);
            if (visit(ray, 0.5 * (t + end), end - t)) break;
            t = end;
        }
#else
        for (int k = 0; k < count; ++k) {
            float at = (float(k) + 0.5) * ds;
            if (visit(ray, from_behind ? span.y - at : span.x + at, ds)) break;
        }
#endif
        seen = end(ray);
    }
    colour = shade(seen, normalize(ray.dir * voxel_um));
}
