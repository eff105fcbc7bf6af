float total = 0.0, near = 0.0;
vec4 nothing() { return vec4(0.0); }
void begin(Ray ray, vec2 span) { near = span.x; }

bool visit(Ray ray, float t, float ds) {
    total += value(ray.from + t * ray.dir) * exp(-fade_per_um * max(t - front_um, 0.0)) * ds;
    return false;
}

vec4 end(Ray ray) { return vec4(total, near, 1.0, 0.0); }
