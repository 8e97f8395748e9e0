// Exact distances to a mesh and its generalised winding number (Barill et al. 2018), both by one tree of boxes.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <vector>

#include "layout.hpp"

namespace graspd {

struct Vec3 {
    double x, y, z;
    Vec3 operator+(const Vec3& o) const { return {x + o.x, y + o.y, z + o.z}; }
    Vec3 operator-(const Vec3& o) const { return {x - o.x, y - o.y, z - o.z}; }
    Vec3 operator*(double s) const { return {x * s, y * s, z * s}; }
    double operator[](int i) const { return i == 0 ? x : i == 1 ? y : z; }
};
inline double dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(const Vec3& a, const Vec3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline double norm(const Vec3& a) { return std::sqrt(dot(a, a)); }
inline Vec3 least(const Vec3& a, const Vec3& b) { return {std::min(a.x, b.x), std::min(a.y, b.y), std::min(a.z, b.z)}; }
inline Vec3 most(const Vec3& a, const Vec3& b) { return {std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z)}; }
inline Vec3 at(const double* p) { return {p[0], p[1], p[2]}; }

struct Triangle {
    Vec3 a, b, c;
};

// A node: its box, and for its triangles the centroid, the sum of area vectors, the radius about the centroid. A leaf
// has `count` triangles. Other nodes have the first child directly after them, and the second at index `second`.
struct SurfaceNode {
    Vec3 low, high, middle, area;
    double radius;
    int32_t first, count, second, unused;
};
static_assert(sizeof(Triangle) == 72 && sizeof(SurfaceNode) == 120, "verify/compiled_overlap.py allocates them");

// Builds the tree, and sorts the triangles in the order of the leaves. There are fewer than two nodes per triangle.
class SurfaceBuilder {
   public:
    SurfaceBuilder(const Triangle* from, int count, SurfaceNode* nodes, Triangle* to)
        : from_(from), nodes_(nodes), to_(to), order_(count) {
        std::iota(order_.begin(), order_.end(), 0);
    }

    int build() {
        if (!order_.empty()) branch(0, int(order_.size()));
        return made_;
    }

   private:
    static constexpr int LEAF = 4;

    int branch(int begin, int end) {
        const int index = made_++;
        SurfaceNode& node = nodes_[index];
        node = {{INFINITY, INFINITY, INFINITY}, {-INFINITY, -INFINITY, -INFINITY}, {0, 0, 0}, {0, 0, 0}, 0, begin, 0, 0, 0};
        double weight = 0;
        Vec3 low = node.low, high = node.high;
        for (int i = begin; i < end; i++) {
            const Triangle& t = from_[order_[i]];
            const Vec3 area = cross(t.b - t.a, t.c - t.a) * 0.5;
            // The small number gives faces without area a weight in the centroid.
            const double size = norm(area) + 1e-30;
            node.low = least(node.low, least(t.a, least(t.b, t.c)));
            node.high = most(node.high, most(t.a, most(t.b, t.c)));
            low = least(low, centroid(t));
            high = most(high, centroid(t));
            node.middle = node.middle + centroid(t) * size;
            node.area = node.area + area;
            weight += size;
        }
        node.middle = node.middle * (1 / weight);
        for (int i = begin; i < end; i++)
            for (const Vec3& corner : {from_[order_[i]].a, from_[order_[i]].b, from_[order_[i]].c})
                node.radius = std::max(node.radius, norm(corner - node.middle));
        if (end - begin <= LEAF) {
            node.count = end - begin;
            for (int i = begin; i < end; i++) to_[i] = from_[order_[i]];
            return index;
        }
        const Vec3 size = high - low;
        const int axis = size.x >= size.y && size.x >= size.z ? 0 : size.y >= size.z ? 1 : 2, half = (begin + end) / 2;
        std::nth_element(order_.begin() + begin, order_.begin() + half, order_.begin() + end, [&](int i, int j) {
            return centroid(from_[i])[axis] < centroid(from_[j])[axis];
        });
        branch(begin, half);
        const int second = branch(half, end);
        nodes_[index].second = second;
        return index;
    }

    static Vec3 centroid(const Triangle& t) { return (t.a + t.b + t.c) * (1.0 / 3); }

    const Triangle* from_;
    SurfaceNode* nodes_;
    Triangle* to_;
    std::vector<int> order_;
    int made_ = 0;
};

// Returns the squared distance to a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
inline double squared_distance(const Triangle& t, const Vec3& p) {
    const Vec3 ab = t.b - t.a, ac = t.c - t.a, ap = p - t.a;
    const double d1 = dot(ab, ap), d2 = dot(ac, ap);
    if (d1 <= 0 && d2 <= 0) return dot(ap, ap);
    const Vec3 bp = p - t.b;
    const double d3 = dot(ab, bp), d4 = dot(ac, bp);
    if (d3 >= 0 && d4 <= d3) return dot(bp, bp);
    const Vec3 cp = p - t.c;
    const double d5 = dot(ab, cp), d6 = dot(ac, cp);
    if (d6 >= 0 && d5 <= d6) return dot(cp, cp);
    const double vc = d1 * d4 - d3 * d2, vb = d5 * d2 - d1 * d6, va = d3 * d6 - d5 * d4;
    Vec3 off;
    if (vc <= 0 && d1 >= 0 && d3 <= 0)
        off = ap - ab * (d1 / (d1 - d3));
    else if (vb <= 0 && d2 >= 0 && d6 <= 0)
        off = ap - ac * (d2 / (d2 - d6));
    else if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0)
        off = bp - (t.c - t.b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    else
        off = ap - ab * (vb / (va + vb + vc)) - ac * (vc / (va + vb + vc));
    return dot(off, off);
}

inline double box_squared(const SurfaceNode& node, const Vec3& p) {
    const Vec3 past = most({0, 0, 0}, most(node.low - p, p - node.high));
    return dot(past, past);
}

constexpr int DEEPEST = 64;

// Returns the distance to the nearest triangle, or `reach` if the triangle is farther.
inline double surface_distance(const Surface& s, const Vec3& p, double reach) {
    struct Entry {
        int node;
        double squared;
    } stack[DEEPEST];
    const SurfaceNode* nodes = (const SurfaceNode*)s.nodes;
    const Triangle* triangles = (const Triangle*)s.triangles;
    double best = reach * reach;
    int top = 0;
    stack[top++] = {0, box_squared(nodes[0], p)};
    while (top) {
        const Entry entry = stack[--top];
        if (!(entry.squared < best)) continue;
        const SurfaceNode& node = nodes[entry.node];
        for (int i = node.first; i < node.first + node.count; i++) best = std::min(best, squared_distance(triangles[i], p));
        if (node.count) continue;
        Entry near = {entry.node + 1, box_squared(nodes[entry.node + 1], p)}, far = {node.second, box_squared(nodes[node.second], p)};
        if (far.squared < near.squared) std::swap(near, far);
        if (far.squared < best) stack[top++] = far;
        if (near.squared < best) stack[top++] = near;
    }
    return std::sqrt(best);
}

// Returns the winding number. A node farther away than `accuracy` times its radius counts as one face.
inline double winding_number(const Surface& s, const Vec3& p, double accuracy) {
    const SurfaceNode* nodes = (const SurfaceNode*)s.nodes;
    const Triangle* triangles = (const Triangle*)s.triangles;
    int stack[DEEPEST], top = 0;
    double angle = 0;
    stack[top++] = 0;
    while (top) {
        const int index = stack[--top];
        const SurfaceNode& node = nodes[index];
        const Vec3 to = node.middle - p;
        const double squared = dot(to, to), near = accuracy * node.radius;
        if (squared > near * near) {
            angle += dot(node.area, to) / (squared * std::sqrt(squared));
        } else if (node.count) {
            for (int i = node.first; i < node.first + node.count; i++) {
                const Vec3 a = triangles[i].a - p, b = triangles[i].b - p, c = triangles[i].c - p;
                const double la = norm(a), lb = norm(b), lc = norm(c);
                angle += 2 * std::atan2(dot(a, cross(b, c)), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb);
            }
        } else {
            stack[top++] = node.second;
            stack[top++] = index + 1;
        }
    }
    return std::fabs(angle) / (4 * M_PI);
}

// A winding number within DOUBT of one half at accuracy COARSE is computed again at accuracy FINE.
constexpr double COARSE = 1.5, FINE = 6, DOUBT = 0.3;

inline double winding_number(const Surface& s, const Vec3& p) {
    if (box_squared(((const SurfaceNode*)s.nodes)[0], p) > 0) return 0;
    const double coarse = winding_number(s, p, COARSE);
    return std::fabs(coarse - 0.5) < DOUBT ? winding_number(s, p, FINE) : coarse;
}

// Measures distances of successive points. The previous point bounds the distance, and gives the side if it is near.
class SurfaceProbe {
   public:
    explicit SurfaceProbe(const Surface& surface) : surface_(surface) {}

    // Returns the distance, negative inside. Outside it is at most `reach`.
    double signed_distance(const Vec3& p, double reach) {
        const double distance = unsigned_distance(p, reach);
        if (!inside(p)) return distance;
        return distance < reach ? -distance : -surface_distance(surface_, p, INFINITY);
    }

    // Returns the distance to the nearest triangle, or `reach` if the triangle is farther.
    double unsigned_distance(const Vec3& p, double reach) {
        const double step = norm(p - place_), known = farthest_ + step;
        here_ = false;
        same_ = known_ && nearest_ - step > 0;
        if (nearest_ - step >= reach) return reach;
        const double distance = surface_distance(surface_, p, std::min(known, reach));
        place_ = p;
        here_ = true;
        known_ = same_;
        nearest_ = distance;
        farthest_ = distance < reach ? distance : INFINITY;
        return distance;
    }

    // Returns the generalised winding number of p. If p is the last point measured, earlier results are used.
    double number(const Vec3& p) {
        // No face lies between the two points, and far from a hole the number hardly changes.
        if (same_) return number_;
        const double number = winding_number(surface_, p);
        if (here_) number_ = number, known_ = std::fabs(number - 0.5) > SURELY;
        return number;
    }

    bool inside(const Vec3& p) { return number(p) > 0.5; }

   private:
    static constexpr double SURELY = 0.45;

    const Surface& surface_;
    Vec3 place_ = {0, 0, 0};
    double nearest_ = 0, farthest_ = INFINITY, number_ = 0.5;
    // True if the last distance was computed, if `number_` holds for the last point, if `number_` is far from one half.
    bool here_ = false, same_ = false, known_ = false;
};

}  // namespace graspd
