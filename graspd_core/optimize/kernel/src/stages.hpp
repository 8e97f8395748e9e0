// From an optimised pose to its pregrasp, and how deep a hand lies in itself (optimize/grasp_postures.py, hands/self_collision.py).
#pragma once
#include "search.hpp"
#include "solid_overlap.hpp"

namespace graspd {

// Shares of the way from pregrasp to grasp that are still to go where it is kept clear.
constexpr int WAY = 3;
constexpr float TO_GO[WAY] = {1.f, 0.6f, 0.2f};

// The base turned as x[3:7] says, at a place of its own.
static void turned_base(const float* quaternion, const float* place, float* base) {
    static const float origin[3] = {0, 0, 0};
    float x[7] = {place[0], place[1], place[2], quaternion[0], quaternion[1], quaternion[2], quaternion[3]};
    Hand at_origin = {};
    at_origin.pivot = origin;
    base_pose(at_origin, x, base);
}

// What the search for a pregrasp remembers between its steps; variables are the base's place and the joints.
struct Opening {
    explicit Opening(const Problem& p)
        : variables(3 + p.hand.joints), start(variables), y(variables), at(variables), mean(variables),
          square(variables), gradient(variables), slope(variables), wanted(std::max(WAY * padded(p.coarse.count), p.fine.count)) {}
    int variables;
    Array<float> start, y, at, mean, square, gradient, slope;
    Array<float> wanted;  // least distance of every candidate at every share of the way
};

// The hand `to_go` before the grasp: link poses and the distances of its coarse candidates.
static void place_on_way(const Problem& p, const float* quaternion, float to_go, Opening& o, Scratch& s) {
    for (int i = 0; i < o.variables; i++) o.at[i] = to_go * o.y[i] + (1 - to_go) * o.start[i];
    float base[12];
    turned_base(quaternion, o.at, base);
    place_links(p.hand, base, o.at + 3, s.link);
    place_points(p.coarse, s.link, s.candidates.x, s.candidates.y, s.candidates.z);
    sample(p.object.grid, p.coarse.count, s.candidates);
}

// Adds the slope of one place on the way: candidates nearer than wanted, obstacles, and the hand in itself.
static void add_way_slope(
    const Problem& p, const float* wanted, float to_go, float self_weight, bool spheres, Opening& o, Scratch& s) {
    Samples& at = s.candidates;
    bool any = false;
    for (int i = 0; i < p.coarse.count; i++) {
        float missing = (wanted[i] - at.phi[i]) * MILLIMETRES;
        any |= !(missing <= 0);
        at.a_phi[i] = missing <= 0 ? 0.f : -2.f * MILLIMETRES * missing / p.coarse.count;
        at.a_nx[i] = at.a_ny[i] = at.a_nz[i] = 0;
    }
    for (int i = 0; i < 6 * p.hand.links; i++) s.wrench[i] = 0;
    if (any) {
        sample_adjoint(p.object.grid, p.coarse.count, at);
        gather_wrenches(p.coarse, at, s.wrench);
    }
    float blocked = obstacle_depth(p, 1.f, s);
    if (self_weight > 0) {
        float deepest;
        if (spheres) blocked += self_collision(p.spheres, self_weight, s.link, s.sphere, s.wrench);
        blocked += solid_overlap(p, self_weight, &deepest, s);
    }
    if (!any && blocked == 0) return;
    for (int i = 0; i < o.variables; i++) o.slope[i] = 0;
    pull_back_joints(p.hand, s.link, s.wrench, o.slope + 3);
    for (int i = 0; i < 3; i++) o.slope[i] = s.wrench[i];
    for (int i = 0; i < o.variables; i++) o.gradient[i] += to_go * o.slope[i];
}

// Begins the gradient: what travel from the grasp costs.
static void add_travel_slope(const Hand& hand, const Pregrasp& settings, Opening& o) {
    for (int i = 0; i < o.variables; i++) {
        float scale = i < 3 ? 1.f : hand.joint_scale[i - 3];
        float cost = i < 3 ? settings.base_cost : settings.joint_cost / (scale * scale);
        o.gradient[i] = 2 * cost * (o.y[i] - o.start[i]);
    }
}

// A step of Adam whose rate fades; a slope that is not a number counts as none.
static void opening_step(const Hand& hand, const Pregrasp& settings, int count, Opening& o) {
    const float first = 1.f / (1.f - powf(BETA1, count)), second = 1.f / (1.f - powf(BETA2, count));
    const float fade = 1.f - 0.9f * count / settings.steps;
    for (int i = 0; i < o.variables; i++) {
        float g = std::isfinite(o.gradient[i]) ? o.gradient[i] : 0.f;
        o.mean[i] = BETA1 * o.mean[i] + (1 - BETA1) * g;
        o.square[i] = BETA2 * o.square[i] + (1 - BETA2) * g * g;
        float rate = i < 3 ? settings.base_rate : settings.joint_rate * hand.joint_scale[i - 3];
        o.y[i] -= fade * rate * (o.mean[i] * first) / (sqrtf(o.square[i] * second) + ADAM_EPSILON);
        if (i >= 3) o.y[i] = std::min(std::max(o.y[i], hand.lower[i - 3]), hand.upper[i - 3]);
    }
}

// x: the base's place, quaternion and joints of a grasp; `out` gets place and joints of the pregrasp. Returns the least
// distance on the way over what it should be there, one where all is clear.
template <class Go>
static float find_pregrasp(const Problem& p, const Pregrasp& settings, const float* x, float* out, Scratch& s, Go go) {
    const Hand& hand = p.hand;
    const int stride = padded(p.coarse.count);
    Opening o(p);
    for (int i = 0; i < o.variables; i++) o.start[i] = o.y[i] = i < 3 ? x[i] : x[4 + i];
    place_on_way(p, x + 3, 0.f, o, s);
    // Where the grasp itself sinks in, the way out starts from that depth.
    for (int k = 0; k < WAY; k++)
        for (int i = 0; i < p.coarse.count; i++)
            o.wanted[k * stride + i] = std::min(s.candidates.phi[i], 0.f) * (1 - TO_GO[k]) + TO_GO[k] * settings.clearance;
    for (int count = 1; count <= settings.steps && go(); count++) {
        add_travel_slope(hand, settings, o);
        for (int k = 0; k < WAY; k++) {
            place_on_way(p, x + 3, TO_GO[k], o, s);
            // The pregrasp alone is kept out of itself: the grasp is already.
            const float self_weight = k == 0 ? settings.self_collision : 0.f;
            add_way_slope(p, o.wanted + k * stride, TO_GO[k], self_weight, settings.spheres != 0, o, s);
        }
        opening_step(hand, settings, count, o);
    }
    float worst = -INFINITY;
    for (int k = 0; k < WAY; k++) {
        place_on_way(p, x + 3, TO_GO[k], o, s);
        for (int i = 0; i < p.coarse.count; i++) {
            float missing = o.wanted[k * stride + i] - s.candidates.phi[i];
            worst = missing <= worst ? worst : missing;
        }
    }
    for (int i = 0; i < o.variables; i++) out[i] = o.y[i];
    return 1.f - worst / settings.clearance;
}

// Adds the slope of what is sunk in, squared, in mm²: candidates in the object, and of each solid the deepest point of
// the object in it.
static void add_sunk_slope(const Problem& p, float weight, float keep, Opening& o, Scratch& s) {
    Samples& at = s.candidates;
    for (int i = 0; i < 6 * p.hand.links; i++) s.wrench[i] = 0;
    bool any = false;
    for (int i = 0; i < p.fine.count; i++) {
        float depth = -at.phi[i] * MILLIMETRES, away = (at.phi[i] - o.wanted[i]) * MILLIMETRES;
        any |= !(depth <= 0) || away > 0;
        at.a_phi[i] = away > 0 ? 2.f * keep * MILLIMETRES * away : depth <= 0 ? 0.f : -2.f * weight * MILLIMETRES * depth;
        at.a_nx[i] = at.a_ny[i] = at.a_nz[i] = 0;
    }
    if (any) {
        sample_adjoint(p.object.grid, p.fine.count, at);
        gather_wrenches(p.fine, at, s.wrench);
    }
    for (int k = 0; k < p.solids.count; k++) {
        float slope[3], depth;
        const int feature = deepest_feature(p, k, &depth, slope, s);
        if (feature < 0) continue;
        const float* point = p.object.features + feature;
        const float pull = 2.f * weight * MILLIMETRES * MILLIMETRES * depth;
        push(s.wrench + 6 * p.solids.link[k], point[0], point[p.object.feature_stride], point[2 * p.object.feature_stride],
             pull * slope[0], pull * slope[1], pull * slope[2]);
    }
    float deepest;
    solid_overlap(p, weight, &deepest, s);
    obstacle_depth(p, weight, s);
    for (int i = 0; i < o.variables; i++) o.slope[i] = 0;
    pull_back_joints(p.hand, s.link, s.wrench, o.slope + 3);
    for (int i = 0; i < 3; i++) o.slope[i] = s.wrench[i];
    for (int i = 0; i < o.variables; i++) o.gradient[i] += o.slope[i];
}

// x: the base's place, quaternion and joints of a grasp; `out` gets place and joints of one near it that sinks in less.
template <class Go>
static void settle(const Problem& p, const Pregrasp& settings, const float* x, float* out, Scratch& s, Go go) {
    Opening o(p);
    for (int i = 0; i < o.variables; i++) o.start[i] = o.y[i] = i < 3 ? x[i] : x[4 + i];
    for (int count = 1; count <= settings.steps && go(); count++) {
        add_travel_slope(p.hand, settings, o);
        float base[12];
        turned_base(x + 3, o.y, base);
        place_links(p.hand, base, o.y + 3, s.link);
        place_points(p.fine, s.link, s.candidates.x, s.candidates.y, s.candidates.z);
        sample(p.object.grid, p.fine.count, s.candidates);
        for (int i = 0; count == 1 && i < p.fine.count; i++)
            o.wanted[i] = s.candidates.phi[i] < settings.clearance ? std::max(s.candidates.phi[i], 0.f) : INFINITY;
        place_solids(p, s);
        add_sunk_slope(p, settings.self_collision, settings.keep, o, s);
        opening_step(p.hand, settings, count, o);
    }
    for (int i = 0; i < o.variables; i++) out[i] = o.y[i];
}

// The sharp points nearest to the solids of a hand at x, the base's place, quaternion and joints.
static void nearest_features(const Problem& p, const float* x, int32_t* pick, float* distance, float* gradient, Scratch& s) {
    float base[12];
    turned_base(x + 3, x, base);
    place_links(p.hand, base, x + 7, s.link);
    place_solids(p, s);
    nearest_features(p, pick, distance, gradient, s);
}

// Greatest depth of a solid in one of a link that is not adjacent.
static float self_overlap(const Problem& p, const float* joints, Scratch& s) {
    const float standing[7] = {0, 0, 0, 1, 0, 0, 0};
    float base[12], deepest;
    turned_base(standing + 3, standing, base);
    place_links(p.hand, base, joints, s.link);
    solid_overlap(p, 0.f, &deepest, s);
    return deepest;
}

}  // namespace graspd
