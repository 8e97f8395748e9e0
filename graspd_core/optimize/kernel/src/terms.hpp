// The simple loss terms (optimize/losses.py), and the choice of the least keys.
#pragma once
#include "distance_grid.hpp"
#include "kinematics.hpp"

namespace graspd {

constexpr float MILLIMETRES = 1000.f, PER_CENTIMETRE = 100.f;
// Distance of the second trial cut from the last cut, as a share of the range of the keys.
constexpr float NEAR_CUT = 1 / 64.f;

// Returns the penetration loss of a depth d: a tenth of d² / (1 + d/10), d in mm. Writes the slope per metre.
INLINE float tempered(float depth, float* slope) {
    float d = depth > 0.f ? depth * MILLIMETRES : depth != depth ? depth : 0.f, shrink = 1.f / (1.f + 0.1f * d);
    *slope = 0.1f * MILLIMETRES * (2.f * d + 0.1f * d * d) * shrink * shrink;
    return 0.1f * d * d * shrink;
}

// Finds the indices of the `wanted` least keys, without NaN, and returns their number. Bisection finds a cut with just
// `wanted` keys below. If equal keys prevent this, the first of the equal keys are taken. `cut` is the first trial, and
// gets the result. Pass the last result, because keys change little from step to step.
static int least(const float* key, int count, int wanted, float* cut, int32_t* out) {
    const int whole = padded(count);
    Floats low = all(INFINITY), high = all(-INFINITY);
    for (int i = 0; i < whole; i += LANES) {
        Floats v = load(key + i);
        low = lesser(v, low);
        high = greater(v < 1e9f ? v : high, high);
    }
    float below = INFINITY, upto = -INFINITY;
    for (int i = 0; i < LANES; i++) {
        below = std::min(below, low[i]);
        upto = std::max(upto, high[i]);
    }
    below = std::nextafter(below, -INFINITY);  // No key is at or below `below`. All keys are at or below `upto`.
    for (int round = 0; round < 64; round++) {
        float middle = round > 0 ? 0.5f * (below + upto) : *cut;
        if (round == 1) middle = *cut + (*cut == below ? NEAR_CUT : -NEAR_CUT) * (upto - below);
        if (!(middle > below && middle < upto)) middle = 0.5f * (below + upto);
        if (!(middle > below && middle < upto)) break;
        Ints under = {};
        for (int i = 0; i < whole; i += LANES) under -= load(key + i) <= middle;
        int found = 0;
        for (int i = 0; i < LANES; i++) found += under[i];
        if (found <= wanted) below = middle;
        if (found >= wanted) upto = middle;
        if (found == wanted) break;
    }
    *cut = upto;
    int picked = 0;
    for (bool ties : {false, true})
        for (int i = 0; i < whole && picked < wanted; i += LANES) {
            Floats v = load(key + i);
            unsigned set = ties ? bits((v > below) & (v <= upto)) : bits(v <= below);
            for (; set && picked < wanted; set &= set - 1) {
                int at = i + __builtin_ctz(set);
                if (at < count) out[picked++] = at;
            }
        }
    return picked;
}

// Returns the loss of candidates below the padded surface. Sets their adjoints, and their keys for `least`.
static float candidate_penetration(int count, float radius, float weight, Samples& at, float* key) {
    Floats total = {};
    for (int i = 0; i < padded(count); i += LANES) {
        Floats gap = load(at.phi + i) - radius, d = gap * -MILLIMETRES;
        d = d < 0.f ? Floats{} : d;  // Keeps NaN.
        Floats shrink = 1.f / (1.f + 0.1f * d);
        total += d * d * shrink;
        store(key + i, magnitude(gap));
        store(at.a_phi + i, -0.1f * MILLIMETRES * weight * (2.f * d + 0.1f * d * d) * shrink * shrink);
        store(at.a_nx + i, Floats{});
        store(at.a_ny + i, Floats{});
        store(at.a_nz + i, Floats{});
    }
    for (int i = count; i < padded(count); i++) key[i] = INFINITY;
    return 0.1f * sum(total);
}

// Finds the least distance of every group's candidates from the padded surface.
static void find_gaps(const Hand& hand, const Points& points, float radius, Scratch& s) {
    for (int g = 0; g < hand.groups; g++) {
        float least_yet = INFINITY;
        int at = points.group_start[g];
        for (int i = at; i < points.group_start[g + 1]; i++)
            if (s.candidates.phi[i] < least_yet) {
                least_yet = s.candidates.phi[i];
                at = i;
            }
        s.gap[g] = least_yet - radius;
        s.gap_at[g] = at;
        s.gap_pair[g] = -1;
    }
}

// Returns the mean distance of the groups [cm], saturating beyond the reach. Adds adjoints to the nearest points.
static float touch(const Hand& hand, float sharp_reach, float weight, Scratch& s) {
    float total = 0;
    for (int g = 0; g < hand.groups; g++) {
        float size = fabsf(s.gap[g]), reach = sharp_reach > 0 ? sharp_reach : hand.reach[g];
        float inverse = 1.f / (size + reach), slope = reach * inverse * reach * inverse;
        total += size * reach * inverse;
        float adjoint = weight * PER_CENTIMETRE / hand.groups * slope * (s.gap[g] < 0 ? -1.f : s.gap[g] > 0 ? 1.f : 0.f);
        if (s.gap_pair[g] >= 0)
            s.pair[s.gap_pair[g]].adjoint += adjoint;
        else
            s.candidates.a_phi[s.gap_at[g]] += adjoint;
    }
    return total * PER_CENTIMETRE / hand.groups;
}

// Returns a tenth of the squared overlaps (R² - d²) / 2R of spheres of non-adjacent links [mm²], and adds forces.
static float self_collision(const Spheres& spheres, float weight, const float* link, Samples& at, float* wrench) {
    const int count = spheres.centers.count, stride = spheres.centers.stride;
    place_points(spheres.centers, link, at.x, at.y, at.z);
    for (int i = 0; i < padded(count); i++) at.gx[i] = at.gy[i] = at.gz[i] = 0;
    float total = 0;
    for (int i = 0; i < count; i++) {
        const float x = at.x[i], y = at.y[i], z = at.z[i], radius = spheres.radius[i];
        for (int b = (i + 1) / LANES * LANES; b < padded(count); b += LANES) {
            Floats dx = load(at.x + b) - x, dy = load(at.y + b) - y, dz = load(at.z + b) - z;
            Floats both = load(spheres.radius + b) + radius;
            Floats share = load(spheres.weight + i * stride + b);
            Floats depth = (both * both - dx * dx - dy * dy - dz * dz) * share * MILLIMETRES;
            for (unsigned set = bits(~(depth <= 0.f)); set; set &= set - 1) {
                int j = __builtin_ctz(set);
                total += 0.1f * depth[j] * depth[j];
                float slope = -0.4f * weight * depth[j] * share[j] * MILLIMETRES;
                float gx = slope * dx[j], gy = slope * dy[j], gz = slope * dz[j];
                at.gx[b + j] += gx;
                at.gy[b + j] += gy;
                at.gz[b + j] += gz;
                at.gx[i] -= gx;
                at.gy[i] -= gy;
                at.gz[i] -= gz;
            }
        }
    }
    if (total != 0) gather_wrenches(spheres.centers, at, wrench);
    return total;
}

// Returns the squared distance of the joints from mid-range, in half ranges, and sets their gradient.
static float posture(const Hand& hand, float weight, const float* joints, float* gradient) {
    float total = 0;
    for (int j = 0; j < hand.joints; j++) {
        float half = 0.5f * (hand.upper[j] - hand.lower[j]);
        float share = (joints[j] - 0.5f * (hand.upper[j] + hand.lower[j])) / half;
        total += share * share;
        gradient[j] = weight * 2.f * share / half;
    }
    return total;
}

}  // namespace graspd
