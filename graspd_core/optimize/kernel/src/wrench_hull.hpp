// Builds the convex hull of wrenches point by point (Barber, Dobkin and Huhdanpaa, The Quickhull Algorithm, 1996).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace graspd {

// The hull of at most 256 points in six dimensions. The caller perturbs them, so that at most six lie on a facet.
class WrenchHull {
   public:
    static constexpr int D = 6;
    static constexpr double FACTORIAL = 720;

    WrenchHull(const double* points, int count) : points_(points), count_(count) {}

    // Builds the hull. Returns false if it has no volume, or if rounding has broken it.
    bool build() {
        int simplex[D + 1];
        if (!first_simplex(simplex)) return false;
        facets_.reserve(ROOM);
        for (int i : simplex)
            for (int d = 0; d < D; d++) middle_[d] += at(i)[d] / (D + 1);
        for (int i = 0; i <= D; i++) {
            made_.push_back(add());
            for (int j = 0, k = 0; j <= D; j++)
                if (j != i) facets_[i].neighbor[k] = j, facets_[i].vertex[k++] = uint8_t(simplex[j]);
            if (!set_first_plane(facets_[i])) return false;
        }
        for (int i = 0; i < count_; i++)
            if (std::find(simplex, simplex + D + 1, i) == simplex + D + 1) find_above(i);
        // Taking the farthest point first makes fewer facets that are removed later.
        while (!outside_.empty() && !broken_) {
            const auto next = std::max_element(outside_.begin(), outside_.end(),
                                               [](const Outside& a, const Outside& b) { return a.height < b.height; });
            const Outside farthest = *next;
            outside_.erase(next);
            insert(farthest.point, farthest.facet);
        }
        return !broken_;
    }

    // Returns the nearest facet's distance to the origin, negative if the origin is outside. Writes its unit normal.
    double nearest(double* normal) const {
        const Facet* best = nullptr;
        for (const Facet& facet : facets_)
            if (alive(facet) && (!best || facet.plane[D] < best->plane[D])) best = &facet;
        std::copy(best->plane, best->plane + D, normal);
        return best->plane[D];
    }

    // Returns the volume. `error`: greatest distance of a vertex from its facet's plane, infinite if dented.
    double volume(double* error) const {
        double sum = *error = 0, rows[D][D][BATCH] = {};
        int filled = 0;
        for (const Facet& facet : facets_) {
            if (!alive(facet)) continue;
            for (int i = 0; i < D; i++) {
                const double* p = at(facet.vertex[i]);
                *error = std::max(*error, dented(facet, i) ? INFINITY : std::fabs(height(facet, p)));
                for (int d = 0; d < D; d++) rows[i][d][filled] = p[d] - middle_[d];
            }
            if (++filled < BATCH) continue;
            sum += sum_of_determinants(rows, filled);
            filled = 0;
        }
        return (sum + sum_of_determinants(rows, filled)) / FACTORIAL;
    }

   private:
    // A facet: outward unit normal and offset, height of the point `looked` above the plane, and vertices in the order
    // in which they were added. Neighbor k lies across the ridge without vertex k.
    struct Facet {
        double plane[D + 1], height;
        int32_t neighbor[D], looked;
        uint8_t vertex[D];
    };
    // A point outside the hull, the new facet that it is highest above, and its height.
    struct Outside {
        int point, facet;
        double height;
    };
    // A ridge between a seen `facet` and an unseen facet `beyond`. The vertex `side` of `facet` is not on the ridge.
    struct Rim {
        int32_t facet, side, beyond;
    };
    // A ridge of new facets. `key`: its four old vertices. `sum`: ONE for each of its facets, plus the facets' numbers.
    struct Ridge {
        uint32_t key, sum;
    };
    static constexpr uint32_t NO_KEY = 0, ONE = 1u << 28;
    static constexpr int DEAD = -1, NEVER = -1, BATCH = 8, ROOM = 16384;

    const double* at(int i) const { return points_ + D * i; }
    static bool alive(const Facet& facet) { return facet.neighbor[0] != DEAD; }

    int add() {
        int f = int(facets_.size());
        if (free_.empty()) {
            facets_.emplace_back();
        } else {
            f = free_.back();
            free_.pop_back();
        }
        facets_[f].looked = NEVER;
        return f;
    }

    static void set_plane(Facet& facet, const double* plane) {
        double square = 0;
        for (int d = 0; d < D; d++) square += plane[d] * plane[d];
        const double scale = 1 / std::sqrt(square);
        for (int d = 0; d <= D; d++) facet.plane[d] = plane[d] * scale;
    }

    static double height(const Facet& facet, const double* p) {
        double sum = -facet.plane[D];
        for (int d = 0; d < D; d++) sum += facet.plane[d] * p[d];
        return sum;
    }

    // Returns true if the hull is dented: vertex k, which neighbor k does not share, is above neighbor k.
    bool dented(const Facet& facet, int k) const { return height(facets_[facet.neighbor[k]], at(facet.vertex[k])) > 0; }

    // Chooses seven points. Each is farthest from the flat through the points before.
    bool first_simplex(int* chosen) const {
        std::vector<double> rest(points_, points_ + D * count_);
        chosen[0] = 0;
        for (int i = 0; i < count_; i++)
            if (at(i)[0] < at(chosen[0])[0]) chosen[0] = i;
        for (int i = 0; i < D * count_; i++) rest[i] -= at(chosen[0])[i % D];
        for (int k = 1; k <= D; k++) {
            double most = 0;
            for (int i = 0; i < count_; i++) {
                double square = 0;
                for (int d = 0; d < D; d++) square += rest[D * i + d] * rest[D * i + d];
                if (square > most) most = square, chosen[k] = i;
            }
            if (!(most > 0)) return false;
            double axis[D];
            for (int d = 0; d < D; d++) axis[d] = rest[D * chosen[k] + d] / std::sqrt(most);
            for (int i = 0; i < count_; i++) {
                double along = 0;
                for (int d = 0; d < D; d++) along += rest[D * i + d] * axis[d];
                for (int d = 0; d < D; d++) rest[D * i + d] -= along * axis[d];
            }
        }
        return true;
    }

    // Computes the plane of a facet of the first simplex by cofactors. Returns false if the plane is degenerate.
    bool set_first_plane(Facet& facet) {
        const uint8_t* vertex = facet.vertex;
        double plane[D + 1] = {};
        for (int d = 0; d < D; d++) {
            double rows[D][D][1] = {};
            rows[0][d][0] = 1;
            for (int i = 1; i < D; i++)
                for (int e = 0; e < D; e++) rows[i][e][0] = at(vertex[i])[e] - at(vertex[0])[e];
            determinants(rows, &plane[d]);
            plane[D] += plane[d] * at(vertex[0])[d];
        }
        set_plane(facet, plane);
        const double side = height(facet, middle_);
        for (double& value : facet.plane) value = side > 0 ? -value : value;
        return side != 0 && std::isfinite(side);
    }

    // Stores the new facet that a point is highest above, if it is above any.
    void find_above(int point) {
        Outside best = {point, DEAD, 0};
        for (int f : made_)
            if (const double up = height(facets_[f], at(point)); up > best.height) best.facet = f, best.height = up;
        if (best.facet != DEAD) outside_.push_back(best);
    }

    // Replaces the facets that the point sees by new facets between the point and their rim. `first` is one seen facet.
    void insert(int index, int first) {
        find_seen(index, first);
        made_.clear();
        for (const Rim& rim : rim_) add_cone(index, rim);
        connect();
        freed_.clear();
        for (size_t i = 0; i < outside_.size();) {
            if (!sees(outside_[i].facet, index)) {
                i++;
                continue;
            }
            freed_.push_back(outside_[i].point);
            outside_[i] = outside_.back();
            outside_.pop_back();
        }
        for (int f : seen_) facets_[f].neighbor[0] = DEAD, free_.push_back(f);
        for (int point : freed_) find_above(point);
    }

    bool sees(int f, int index) const { return facets_[f].looked == index && facets_[f].height > 0; }

    // Finds all facets that the point sees. They are connected, so the search goes from neighbor to neighbor.
    void find_seen(int index, int first) {
        facets_[first].looked = index;
        facets_[first].height = height(facets_[first], at(index));
        seen_.assign(1, first);
        rim_.clear();
        for (size_t i = 0; i < seen_.size(); i++) {
            const int f = seen_[i];
            for (int k = 0; k < D; k++) {
                const int beyond = facets_[f].neighbor[k];
                Facet& other = facets_[beyond];
                if (other.looked != index) {
                    other.looked = index;
                    other.height = height(other, at(index));
                    if (other.height > 0) seen_.push_back(beyond);
                }
                if (!(other.height > 0)) rim_.push_back({f, k, beyond});
            }
        }
    }

    // Adds a facet from a ridge of the rim to a new vertex.
    void add_cone(int index, const Rim& rim) {
        const int made = add();
        made_.push_back(made);
        Facet &facet = facets_[made], &beyond = facets_[rim.beyond];
        const Facet& seen = facets_[rim.facet];
        // A plane through the ridge is a weighted sum of the two planes that meet there.
        double plane[D + 1];
        for (int d = 0; d <= D; d++) plane[d] = seen.height * beyond.plane[d] - beyond.height * seen.plane[d];
        set_plane(facet, plane);
        for (int i = 0; i < D - 1; i++) facet.vertex[i] = seen.vertex[i + (i >= rim.side)];
        facet.vertex[D - 1] = uint8_t(index);
        std::fill(facet.neighbor, facet.neighbor + D, 0);
        facet.neighbor[D - 1] = rim.beyond;
        int32_t* place = std::find(beyond.neighbor, beyond.neighbor + D, rim.facet);
        if (place == beyond.neighbor + D)
            broken_ = true;
        else
            *place = made;
    }

    // Connects new facets that share a ridge: four old vertices and the new vertex.
    void connect() {
        int bits = 6;
        while ((size_t(1) << bits) < 2 * (D - 1) * made_.size()) bits++;
        const uint32_t last = (uint32_t(1) << bits) - 1;
        ridges_.assign(size_t(last) + 1, Ridge{NO_KEY, 0});
        slots_.resize((D - 1) * made_.size());
        uint32_t* at = slots_.data();
        for (int f : made_) {
            uint8_t vertex[D - 1];
            std::copy(facets_[f].vertex, facets_[f].vertex + D - 1, vertex);
            for (int k = 0; k < D - 1; k++) {
                uint32_t key = 0;
                for (int i = 0; i < D - 1; i++)
                    if (i != k) key = key << 8 | vertex[i];
                uint32_t slot = key * 2654435769u >> (32 - bits);
                while (ridges_[slot].key != key && ridges_[slot].key != NO_KEY) slot = (slot + 1) & last;
                ridges_[slot].key = key;
                ridges_[slot].sum += ONE + f;
                *at++ = slot;
            }
        }
        const uint32_t* slot = slots_.data();
        for (int f : made_)
            for (int k = 0; k < D - 1; k++, slot++) {
                const uint32_t sum = ridges_[*slot].sum;
                // Because of rounding, a ridge may belong to one facet or to three.
                broken_ |= sum / ONE != 2;
                facets_[f].neighbor[k] = int32_t(sum % ONE) - f;
            }
    }

    static double sum_of_determinants(const double (&rows)[D][D][BATCH], int count) {
        double each[BATCH], sum = 0;
        determinants(rows, each);
        for (int i = 0; i < count; i++) sum += std::fabs(each[i]);
        return sum;
    }

    // Computes the determinants of several matrices at once, by minors of three rows (Laplace).
    template <int N>
    static void determinants(const double (&rows)[D][D][N], double* out) {
        std::fill(out, out + N, 0.0);
        for (int a = 0; a < D; a++)
            for (int b = a + 1; b < D; b++)
                for (int c = b + 1; c < D; c++) {
                    int others[D / 2], n = 0;
                    for (int i = 0; i < D; i++)
                        if (i != a && i != b && i != c) others[n++] = i;
                    const double sign = (a + b + c) % 2 ? 1 : -1;
                    const int *o = others, half = D / 2;
                    for (int i = 0; i < N; i++)
                        out[i] += sign * minor(rows, 0, a, b, c, i) * minor(rows, half, o[0], o[1], o[2], i);
                }
    }

    template <int N>
    static double minor(const double (&m)[D][D][N], int row, int a, int b, int c, int i) {
        const auto &r = m[row], &s = m[row + 1], &t = m[row + 2];
        return r[a][i] * (s[b][i] * t[c][i] - s[c][i] * t[b][i]) - r[b][i] * (s[a][i] * t[c][i] - s[c][i] * t[a][i]) +
               r[c][i] * (s[a][i] * t[b][i] - s[b][i] * t[a][i]);
    }

    const double* points_;
    int count_;
    double middle_[D] = {};
    std::vector<Facet> facets_;
    std::vector<Outside> outside_;
    std::vector<int> free_, seen_, made_, freed_;
    std::vector<Rim> rim_;
    std::vector<Ridge> ridges_;
    std::vector<uint32_t> slots_;  // index in `ridges_` of each ridge of the new facets
    bool broken_ = false;
};

}  // namespace graspd
