// Measures overlaps of the hand's solids by the separating axis test (hands/self_collision.py).
#pragma once
#include "sharp_points.hpp"

namespace graspd {

constexpr float PARALLEL = 1e-3f, SQUARE = 1e-4f, RATHER_FACES = 1e-6f;

// A solid at its pose in the object frame.
struct PlacedSolid {
    PlacedSolid(const Solids& solids, int k, const float* placed)
        : t(placed + 12 * k), core(solids.core + 3 * k), radius(solids.radius[k]), round(solids.round[k] != 0) {}
    const float *t, *core;
    float radius;
    bool round;

    // Returns half the extent along a unit direction u.
    float width(const float* u) const {
        float x = along(0, u), y = along(1, u), z = along(2, u);
        float flat = round ? core[0] * sqrtf(x * x + y * y) : core[0] * fabsf(x) + core[1] * fabsf(y);
        return flat + core[2] * fabsf(z) + radius;
    }
    // Returns the component of a direction u along an axis of the solid.
    float along(int axis, const float* u) const { return t[axis] * u[0] + t[4 + axis] * u[1] + t[8 + axis] * u[2]; }
    // Computes the farthest point along u, or along -u if `side` is -1. A farthest face or edge gives its middle.
    void support(const float* u, float side, float* point) const {
        float v[3];
        for (int i = 0; i < 3; i++) v[i] = fabsf(along(i, u)) < SQUARE ? 0.f : along(i, u);
        float across = std::max(sqrtf(v[0] * v[0] + v[1] * v[1]), 1e-12f);
        for (int i = 0; i < 3; i++)
            v[i] = core[i] * (round && i < 2 ? v[i] / across : v[i] > 0 ? 1.f : v[i] < 0 ? -1.f : 0.f);
        for (int r = 0; r < 3; r++)
            point[r] = t[4 * r + 3] + side * (t[4 * r] * v[0] + t[4 * r + 1] * v[1] + t[4 * r + 2] * v[2] + radius * u[r]);
    }
};

// The least overlap of two solids found so far, and its direction u from b to a.
struct LeastOverlap {
    const PlacedSolid &a, &b;
    const float* apart;  // from the middle of b to the middle of a
    float rated = INFINITY, depth = INFINITY, u[3] = {0, 0, 0};
    int which = -1;

    // Tests a direction of any length. Returns false if the direction separates the solids.
    bool look(int direction, float x, float y, float z, float shortest) {
        float length = sqrtf(x * x + y * y + z * z);
        if (!(length > shortest)) return true;
        float v[3] = {x / length, y / length, z / length};
        float middle = v[0] * apart[0] + v[1] * apart[1] + v[2] * apart[2];
        float deep = a.width(v) + b.width(v) - fabsf(middle), rate = deep + (direction < 6 ? 0.f : RATHER_FACES);
        if (rate < rated) {
            rated = rate;
            depth = deep;
            which = direction;
            for (int i = 0; i < 3; i++) u[i] = middle < 0 ? -v[i] : v[i];
        }
        return deep > 0;
    }

    // Returns true if the line between the middles separates the solids, as for most near pairs.
    bool clear_between() const {
        float squared = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2];
        float across = a.width(apart) - a.radius + b.width(apart) - b.radius;
        return across + (a.radius + b.radius) * sqrtf(squared) <= squared;
    }

    bool look_everywhere() {
        if (clear_between()) return false;
        for (int i = 0; i < 6; i++) {
            const float* t = (i < 3 ? a : b).t + i % 3;
            if (!look(i, t[0], t[4], t[8], PARALLEL)) return false;
        }
        for (int i = 0; i < 9; i++) {
            const float *e = a.t + i / 3, *f = b.t + i % 3;
            if (!look(6 + i, e[4] * f[8] - e[8] * f[4], e[8] * f[0] - e[0] * f[8], e[0] * f[4] - e[4] * f[0], PARALLEL))
                return false;
        }
        if (!a.round && !b.round && a.core[0] != 0 && b.core[0] != 0) return true;
        if (!look(15, apart[0], apart[1], apart[2], 1e-6f)) return false;
        for (int i = 0; i < 2; i++) {
            const float* t = (i == 0 ? a : b).t + 2;
            float on = t[0] * apart[0] + t[4] * apart[1] + t[8] * apart[2];
            if (!look(16 + i, apart[0] - on * t[0], apart[1] - on * t[4], apart[2] - on * t[8], 1e-6f)) return false;
        }
        return true;
    }

    // Computes a point in the overlap, at which forces act.
    void place(float* point) const {
        float of_a[3], of_b[3];
        a.support(u, -1.f, of_a);
        b.support(u, 1.f, of_b);
        if (which < 3 || which >= 15) {
            for (int i = 0; i < 3; i++) point[i] = which < 3 ? of_b[i] : 0.5f * (of_a[i] + of_b[i]);
            return;
        }
        for (int i = 0; i < 3; i++) point[i] = of_a[i];
        if (which < 6) return;
        // Takes the point of a's edge nearest to b's edge.
        const float *e = a.t + (which - 6) / 3, *f = b.t + (which - 6) % 3;
        float slope = 0, on_a = 0, on_b = 0, reach = a.core[(which - 6) / 3];
        for (int i = 0; i < 3; i++) {
            slope += e[4 * i] * f[4 * i];
            on_a += e[4 * i] * (of_a[i] - of_b[i]);
            on_b += f[4 * i] * (of_a[i] - of_b[i]);
        }
        float share = (slope * on_b - on_a) / std::max(1.f - slope * slope, 1e-6f);
        share = std::min(std::max(share, -reach), reach);
        for (int i = 0; i < 3; i++) point[i] += share * e[4 * i];
    }
};

// Returns a tenth of the squared overlap of a pair [mm²], adds forces to the links, and updates `deepest` [m].
static float pair_overlap(const Problem& p, int i, int j, float weight, float* deepest, Scratch& s) {
    const Solids& solids = p.solids;
    PlacedSolid a(solids, i, s.solid), b(solids, j, s.solid);
    const float apart[3] = {a.t[3] - b.t[3], a.t[7] - b.t[7], a.t[11] - b.t[11]};
    LeastOverlap least = {a, b, apart};
    if (!least.look_everywhere() || !(least.depth > 0)) return 0;
    *deepest = std::max(*deepest, least.depth);
    const float depth = least.depth * MILLIMETRES, slope = 0.2f * weight * depth * MILLIMETRES, *u = least.u;
    float at[3];
    least.place(at);
    push(s.wrench + 6 * solids.link[i], at[0], at[1], at[2], -slope * u[0], -slope * u[1], -slope * u[2]);
    push(s.wrench + 6 * solids.link[j], at[0], at[1], at[2], slope * u[0], slope * u[1], slope * u[2]);
    return 0.1f * depth * depth;
}

// Returns the sum of `pair_overlap` over the solids of links that are not adjacent.
static float solid_overlap(const Problem& p, float weight, float* deepest, Scratch& s) {
    const int count = p.solids.count, whole = padded(count);
    place_solids(p, s);
    for (int k = 0; k < count; k++)
        for (int i = 0; i < 3; i++) s.middle[i][k] = s.solid[12 * k + 4 * i + 3];
    float total = 0;
    *deepest = 0;
    for (int k = 0; k < count; k++) {
        const float x = s.middle[0][k], y = s.middle[1][k], z = s.middle[2][k];
        for (int b = (k + 1) / LANES * LANES; b < whole; b += LANES) {
            Floats dx = load(s.middle[0] + b) - x, dy = load(s.middle[1] + b) - y, dz = load(s.middle[2] + b) - z;
            unsigned set = bits(dx * dx + dy * dy + dz * dz < load(p.solids.near + k * p.solids.stride + b));
            for (; set; set &= set - 1) total += pair_overlap(p, k, b + __builtin_ctz(set), weight, deepest, s);
        }
    }
    return total;
}

}  // namespace graspd
