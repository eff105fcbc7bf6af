// The ray of this pixel in voxels; its direction is 1 µm long. Row 0 is the top of the picture.
uniform vec3 corner, right, down, along, eye, voxel_um;
uniform bool perspective;

struct Ray {
    vec3 from;  // on the screen plane
    vec3 dir;   // voxels per µm
    float nearest;  // nothing before this is seen, µm
};

Ray pixel_ray() {
    vec2 pixel = gl_FragCoord.xy - 0.5;
    vec3 from = corner + pixel.x * right + pixel.y * down;
    vec3 dir = perspective ? from - eye : along;
    float reach = length(dir * voxel_um);
    return Ray(from, dir / reach, perspective ? -reach : -1e9);
}

// Where a ray is between two opposite corners of a box: near and far, in µm from the screen plane.
vec2 box_span(Ray ray, vec3 low, vec3 high) {
    vec3 way = mix(ray.dir, vec3(1e-9), lessThan(abs(ray.dir), vec3(1e-9)));
    vec3 a = (low - ray.from) / way, b = (high - ray.from) / way;
    vec3 first = min(a, b), last = max(a, b);
    return vec2(max(max(first.x, first.y), max(first.z, ray.nearest)), min(last.x, min(last.y, last.z)));
}

// Where a ray leaves the voxel it is in at t.
float voxel_exit(Ray ray, float t) {
    vec3 way = mix(ray.dir, vec3(1e-9), lessThan(abs(ray.dir), vec3(1e-9)));
    vec3 at = ray.from + t * way + 0.5;
    vec3 wall = mix(ceil(at - 1e-4) - 1.0, floor(at + 1e-4) + 1.0, greaterThan(way, vec3(0.0)));
    vec3 ways = (wall - at) / way;
    return t + max(min(ways.x, min(ways.y, ways.z)), 1e-5 * min(voxel_um.x, min(voxel_um.y, voxel_um.z)));
}
