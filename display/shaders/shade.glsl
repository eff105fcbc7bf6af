// From what a ray saw to linear light, premultiplied by alpha.
#define TABLE 0    // (value, distance, seen, -): a colour of the table
#define SURFACE 1  // (normal, distance): a lit surface; normal 0 is nothing
#define COLOUR 2   // light and alpha themselves
uniform sampler2D table;  // linear light of 256 values
uniform vec3 to_light;
uniform vec4 answer;  // ambient, diffuse, specular, shininess
uniform vec3 surface_colour;

vec3 table_colour(float v) {
    return texture(table, vec2((v * 255.0 + 0.5) / 256.0, 0.5)).rgb;
}

// Ambient, diffuse and mirrored light (Blinn 1977) of a surface seen from both sides.
vec3 lit(vec3 normal, vec3 dir_um, vec3 colour) {
    vec3 n = faceforward(normal, dir_um, normal);
    vec3 halfway = normalize(to_light - dir_um);
    float diffuse = max(dot(n, to_light), 0.0);
    float mirrored = diffuse > 0.0 ? pow(max(dot(n, halfway), 0.0), answer.w) : 0.0;
    return colour * (answer.x + answer.y * diffuse) + answer.z * mirrored;
}

vec4 shade(vec4 seen, vec3 dir_um) {
#if SHADE == TABLE
    return seen.z > 0.0 ? vec4(table_colour(seen.x), 1.0) : vec4(0.0);
#elif SHADE == SURFACE
    return dot(seen.xyz, seen.xyz) > 0.0 ? vec4(lit(seen.xyz, dir_um, surface_colour), 1.0) : vec4(0.0);
#else
    return seen;
#endif
}
