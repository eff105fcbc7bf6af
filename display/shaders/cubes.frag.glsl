// Voxels that a plane cuts, as whole cubes.
#include "camera.glsl"
#include "volume.glsl"
#include "shade.glsl"
uniform vec4 planes[1];
uniform float transparent;
uniform float pixel_um;

out vec4 colour;

void main() {
    Ray ray = pixel_ray();
    colour = vec4(0.0);
    vec3 way = mix(ray.dir, vec3(1e-9), lessThan(abs(ray.dir), vec3(1e-9)));
    vec2 span = box_span(ray, low, high);
    float half_width = 0.5 * (abs(planes[0].x) + abs(planes[0].y) + abs(planes[0].z));
    float towards = dot(planes[0].xyz, way);
    float reach = 2.0 * half_width / max(abs(towards), 1e-9);  // beyond, no cube can be cut
    float middle = (planes[0].w - dot(planes[0].xyz, ray.from)) / towards;
    if (abs(towards) > 1e-9) span = vec2(max(span.x, middle - reach), min(span.y, middle + reach));
    for (float t = span.x; t < span.y;) {
        float end = voxel_exit(ray, t);
        vec3 voxel = floor(ray.from + 0.5 * (t + end) * way + 0.5);
        bool cut = abs(dot(planes[0].xyz, voxel) - planes[0].w) <= half_width;
        if (cut && (raw_value(voxel) - limits.x) / (limits.y - limits.x) >= transparent) {
            vec3 walls = (voxel - 0.5 * sign(way) - ray.from) / way;
            float entry = max(walls.x, max(walls.y, walls.z));
            vec3 normal = -sign(way) * vec3(equal(walls, vec3(entry)));
            vec3 inside = abs(ray.from + entry * way - voxel) * voxel_um;  // from the middle of the face
            vec3 edge = mix(0.5 * voxel_um - inside, vec3(1e9), greaterThan(abs(normal), vec3(0.5)));
            float line = smoothstep(0.0, 1.5 * pixel_um, min(edge.x, min(edge.y, edge.z)));
            float fine = smoothstep(3.0, 8.0, min(voxel_um.x, min(voxel_um.y, voxel_um.z)) / pixel_um);
            vec3 dir_um = normalize(ray.dir * voxel_um);
            colour = vec4(lit(normal, dir_um, table_colour(value(voxel))) * mix(1.0, 0.35 + 0.65 * line, fine), 1.0);
            return;
        }
        t = end;
    }
}
