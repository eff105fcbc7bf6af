vec3 best = vec3(0.0);
float where = 0.0;
vec4 nothing() { return vec4(0.0); }
void begin(Ray ray, vec2 span) {}

bool visit(Ray ray, float t, float ds) {
    vec3 change = gradient(ray.from + t * ray.dir);
    if (dot(change, change) > dot(best, best)) { best = change; where = t; }
    return false;
}

vec4 end(Ray ray) {
    float size = length(best);
    return size * min(voxel_um.x, min(voxel_um.y, voxel_um.z)) > threshold ? vec4(-best / size, where) : vec4(0.0);
}
