// Measures how deep points are in a hand, and the volume that a hand and an object share.
#pragma once
#include <array>
#include <map>

#include "surface_tree.hpp"

namespace graspd {

// A convex solid at its pose: a box, sphere, capsule or cylinder in one common form, or the planes of a hull.
struct PlacedBody {
    PlacedBody(const Bodies& bodies, int k, const double* links) : core(at(bodies.core + 3 * k)) {
        const double *in = bodies.pose + 12 * k, *link = links + 12 * bodies.link[k], *local = bodies.ball + 4 * k;
        for (int r = 0; r < 3; r++) {
            for (int c = 0; c < 3; c++)
                turn[r][c] = link[4 * r] * in[c] + link[4 * r + 1] * in[4 + c] + link[4 * r + 2] * in[8 + c];
            (&origin.x)[r] = link[4 * r] * in[3] + link[4 * r + 1] * in[7] + link[4 * r + 2] * in[11] + link[4 * r + 3];
        }
        middle = origin + turned(at(local));
        reach = local[3];
        radius = bodies.radius[k];
        round = bodies.round[k] != 0;
        planes = bodies.planes + 4 * bodies.plane_start[k];
        count = bodies.plane_start[k + 1] - bodies.plane_start[k];
    }

    Vec3 turned(const Vec3& v) const {
        return {turn[0][0] * v.x + turn[0][1] * v.y + turn[0][2] * v.z, turn[1][0] * v.x + turn[1][1] * v.y + turn[1][2] * v.z,
                turn[2][0] * v.x + turn[2][1] * v.y + turn[2][2] * v.z};
    }

    // Returns the signed distance, negative inside. Outside a hull it is a lower bound.
    double distance(const Vec3& p) const {
        const Vec3 off = p - origin;
        Vec3 l = {turn[0][0] * off.x + turn[1][0] * off.y + turn[2][0] * off.z,
                  turn[0][1] * off.x + turn[1][1] * off.y + turn[2][1] * off.z,
                  turn[0][2] * off.x + turn[1][2] * off.y + turn[2][2] * off.z};
        if (count) {
            double farthest = -INFINITY;
            for (const double* n = planes; n < planes + 4 * count; n += 4)
                farthest = std::max(farthest, n[0] * l.x + n[1] * l.y + n[2] * l.z - n[3]);
            return farthest;
        }
        l = {std::fabs(l.x), std::fabs(l.y), std::fabs(l.z)};
        if (round) l = {std::sqrt(l.x * l.x + l.y * l.y), 0, l.z};
        const Vec3 past = l - core;
        return norm(most(past, {0, 0, 0})) + std::min(0.0, std::max(past.x, std::max(past.y, past.z))) - radius;
    }

    Vec3 core, origin, middle;
    double turn[3][3], reach, radius;
    bool round;
    const double* planes;
    int count;
};

inline std::vector<PlacedBody> placed_bodies(const Bodies& bodies, const double* links) {
    std::vector<PlacedBody> placed;
    placed.reserve(bodies.count);
    for (int k = 0; k < bodies.count; k++) placed.emplace_back(bodies, k, links);
    return placed;
}

// Returns the greatest depth of a point inside a solid, at least zero. If `link_of` (link of each point) is given, a
// solid is tested only with points of links that its own link must not touch (`apart`, links x links).
inline double depth_in_bodies(const Bodies& bodies, const double* links, int count, const double* points,
                              const int32_t* link_of, const uint8_t* apart) {
    const std::vector<PlacedBody> placed = placed_bodies(bodies, links);
    std::vector<int> near;
    double deepest = 0;
    for (int k = 0; k < bodies.count;) {
        // The points near a link are found once for all solids of the link.
        int end = k;
        Vec3 low = {INFINITY, INFINITY, INFINITY}, high = low * -1;
        for (; end < bodies.count && bodies.link[end] == bodies.link[k]; end++) {
            const PlacedBody& body = placed[end];
            const Vec3 reach = {body.reach, body.reach, body.reach};
            low = least(low, body.middle - reach);
            high = most(high, body.middle + reach);
        }
        const uint8_t* meets = apart ? apart + bodies.links * bodies.link[k] : nullptr;
        near.clear();
        for (int i = 0; i < count; i++) {
            const double* p = points + 3 * i;
            const bool in = (p[0] > low.x) & (p[0] < high.x) & (p[1] > low.y) & (p[1] < high.y) & (p[2] > low.z) & (p[2] < high.z);
            if (in && (!meets || meets[link_of[i]])) near.push_back(i);
        }
        for (; k < end; k++)
            for (int i : near) {
                const Vec3 p = at(points + 3 * i), off = p - placed[k].middle;
                if (dot(off, off) < placed[k].reach * placed[k].reach) deepest = std::max(deepest, -placed[k].distance(p));
            }
    }
    return deepest;
}

// Sums the volume that hand and object share over cells of a lattice in the base frame. An octree finds the cells. In a
// cell, hand and object count as half-spaces that face each other.
class SharedVolume {
   public:
    SharedVolume(const Bodies& bodies, const double* links, const Surface& surface, double cell)
        : surface_(surface), probe_(surface), base_(links), cell_(cell), placed_(placed_bodies(bodies, links)) {}

    double measure() {
        std::map<Cell, std::vector<int>> roots;
        for (int k = 0; k < int(placed_.size()); k++) {
            int from[3], to[3];
            range(placed_[k], from, to);
            for (int x = from[0]; x < to[0]; x++)
                for (int y = from[1]; y < to[1]; y++)
                    for (int z = from[2]; z < to[2]; z++)
                        if (placed_[k].distance(middle_of({x, y, z}, SIZE)) < reach_of(SIZE)) roots[{x, y, z}].push_back(k);
        }
        for (const auto& [cell, which] : roots) descend(cell, SIZE, which, false);
        return sum_ * cell_ * cell_ * cell_;
    }

   private:
    // Width of a coarsest cell, in finest cells.
    static constexpr int SIZE = 8;
    // Position of a cell, in cells of the same size.
    using Cell = std::array<int, 3>;

    // A cell without near faces is entirely inside if the winding number at its middle exceeds this.
    static constexpr double SURELY = 0.95;

    // Finds the coarsest cells around a solid that may touch the object's box.
    void range(const PlacedBody& body, int* from, int* to) const {
        const SurfaceNode& all = ((const SurfaceNode*)surface_.nodes)[0];
        const Vec3 box = (all.low + all.high) * 0.5, half = (all.high - all.low) * 0.5;
        for (int i = 0; i < 3; i++) {
            const Vec3 axis = {base_[i], base_[4 + i], base_[8 + i]}, origin = {base_[3], base_[7], base_[11]};
            const double of_body = dot(axis, body.middle - origin), of_box = dot(axis, box - origin);
            const double reach = std::fabs(axis.x) * half.x + std::fabs(axis.y) * half.y + std::fabs(axis.z) * half.z + cell_;
            from[i] = int(std::floor(std::max(of_body - body.reach, of_box - reach) / (SIZE * cell_)));
            to[i] = int(std::ceil(std::min(of_body + body.reach, of_box + reach) / (SIZE * cell_)));
        }
    }

    Vec3 middle_of(const Cell& cell, int size) const {
        Vec3 p = {base_[3], base_[7], base_[11]};
        for (int i = 0; i < 3; i++) p = p + Vec3{base_[i], base_[4 + i], base_[8 + i]} * ((cell[i] + 0.5) * size * cell_);
        return p;
    }
    // Returns a distance from a cell's middle. Farther surfaces touch no finest cell in the cell. Has a margin.
    double reach_of(int size) const { return (0.8660254 * 1.001 * (size - 1) + 0.5) * cell_; }

    // Adds the shared volume in a cell. `inside`: the object fills the whole cell.
    void descend(const Cell& cell, int size, const std::vector<int>& which, bool inside) {
        const Vec3 p = middle_of(cell, size);
        const double reach = reach_of(size);
        std::vector<int> near;
        double deepest = -INFINITY;
        for (int k : which) {
            const Vec3 off = p - placed_[k].middle;
            const double most = reach + placed_[k].reach;
            if (dot(off, off) > most * most) continue;
            const double depth = -placed_[k].distance(p);
            deepest = std::max(deepest, depth);
            if (depth > -reach && size > 1) near.push_back(k);
        }
        const double filled = share(deepest);
        if (size == 1) {
            if (filled <= 0) return;
            // The distance is limited to half a cell, because a cell farther inside or outside is full or empty.
            const double off = inside ? 0 : probe_.unsigned_distance(p, reach);
            sum_ += std::max(0.0, filled + (inside ? 1 : share(probe_.inside(p) ? off : -off)) - 1);
            return;
        }
        if (near.empty()) return;
        if (!inside && probe_.unsigned_distance(p, reach) >= reach) {
            const double number = probe_.number(p);
            if (!(number > 0.5)) return;
            inside = number > SURELY;
        }
        for (int i = 0; i < 8; i++)
            descend({2 * cell[0] + (i >> 2), 2 * cell[1] + (i >> 1 & 1), 2 * cell[2] + (i & 1)}, size / 2, near, inside);
    }

    // Returns the share of a cell that a half-space fills, from the depth of the cell's middle.
    double share(double depth) const { return std::min(1.0, std::max(0.0, 0.5 + depth / cell_)); }

    const Surface& surface_;
    SurfaceProbe probe_;
    const double* base_;
    const double cell_;
    const std::vector<PlacedBody> placed_;
    double sum_ = 0;
};

}  // namespace graspd
