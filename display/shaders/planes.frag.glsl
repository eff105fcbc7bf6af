// Planes through a volume, the nearest first; those of a stack may be pulled apart.
#include "camera.glsl"
#include "volume.glsl"
#include "shade.glsl"
uniform int count;
uniform vec4 planes[PLANES];  // normal and distance, n · p = d, in voxels
uniform vec3 moved[PLANES];  // added to a point to find its value
uniform vec3 tints[PLANES];
uniform float transparent;

out vec4 colour;

void main() {
    Ray ray = pixel_ray();
    float best = 1e18;
    colour = vec4(0.0);
    for (int k = 0; k < count; ++k) {
        float towards = dot(planes[k].xyz, ray.dir);
        if (abs(towards) < 1e-9) continue;
        float t = (planes[k].w - dot(planes[k].xyz, ray.from)) / towards;
        vec3 place = ray.from + t * ray.dir + moved[k];
        bool inside = all(greaterThanEqual(place, low - 1e-4)) && all(lessThanEqual(place, high + 1e-4));
        if (t <= ray.nearest || t >= best || !inside) continue;
        if ((raw_value(place) - limits.x) / (limits.y - limits.x) < transparent) continue;
        best = t;
        colour = vec4(table_colour(value(place)) * tints[k], 1.0);
    }
}
