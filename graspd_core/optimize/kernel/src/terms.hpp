// The loss terms that look at one thing each (optimize/losses.py), and the choice of the nearest few.
#pragma once
#include "distance_grid.hpp"
#include "kinematics.hpp"

namespace graspd {

constexpr float MILLIMETRES = 1000.f, PER_CENTIMETRE = 100.f;
// How far from the last cut the next is looked for, of the range of the keys.
constexpr float NEAR_CUT = 1 / 64.f;

// Tempered depth d²/(1 + d/10) for d in mm, over 10, and its slope per metre.
INLINE float tempered(float depth, float* slope) {
    float d = depth > 0.f ? depth * MILLIMETRES : depth != depth ? depth : 0.f, shrink = 1.f / (1.f + 0.1f * d);
    *slope = 0.1f * MILLIMETRES * (2.f * d + 0.1f * d * d) * shrink * shrink;
    return 0.1f * d * d * shrink;
}

// Indices of the `wanted` least keys; NaN is never among them. Halves between bounds until as many lie below, or the
// bounds meet: then equal keys fill up from the first. It begins at `cut`, up to which the last choice went: keys change
// little from step to step. Returns how many there are.
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
    below = std::nextafter(below, -INFINITY);  // no key is at or under `below`; `upto` has all
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

// Depth of the candidates below the padded surface. Begins their adjoints, and the keys of the nearest.
static float candidate_penetration(int count, float radius, float weight, Samples& at, float* key) {
    Floats total = {};
    for (int i = 0; i < padded(count); i += LANES) {
        Floats gap = load(at.phi + i) - radius, d = gap * -MILLIMETRES;
        d = d < 0.f ? Floats{} : d;  // keeps what is not a number
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

// Least distance of every group's candidates from the padded surface.
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

// Attraction of every group to the surface, saturating beyond its reach; its slope goes to who has the least distance.
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

// Overlap of the proxy spheres of links that are not adjacent: (R² - d²) / 2R, squared, in mm².
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

// Squared distance of the joints from mid-range in half ranges; begins their gradient.
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
