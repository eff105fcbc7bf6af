vec4 found = vec4(0.0);
float last = 0.0;
vec4 nothing() { return vec4(0.0); }
void begin(Ray ray, vec2 span) { last = from_behind ? span.y : span.x; }

bool visit(Ray ray, float t, float ds) {
    if (value(ray.from + t * ray.dir) < threshold) { last = t; return false; }
    float inside = t, outside = last;
    for (int k = 0; k < 5; ++k) {
        float middle = 0.5 * (inside + outside);
        if (value(ray.from + middle * ray.dir) >= threshold) inside = middle; else outside = middle;
    }
    vec3 change = gradient(ray.from + inside * ray.dir);
    float size = length(change);
    found = vec4(size > 1e-9 ? -change / size : vec3(0.0, 0.0, -1.0), inside);
    return true;
}

vec4 end(Ray ray) { return found; }
