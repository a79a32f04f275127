// Gauss–Seidel on a regular grid: edges to the next particle, to the diagonal one and to the next
// but one, in one pass over memory per substep. As few instructions as we know how; no
// multipliers, which a single iteration does not need.
//
// The order: strips of rows from first to last. A strip is predicted, its edges are projected
// kind by kind, each kind in two halves that share no particle, and rows that no later strip
// touches get their velocities. With one strip as high as the sheet this is plain colouring.

#pragma once

#include "sheet.hpp"

#include <algorithm>
#include <cstdint>

struct Grid {    // in any precision
    virtual ~Grid() = default;
    virtual void set(const double *x, const double *v) = 0;
    virtual void get(double *x, double *v) const = 0;
    virtual int order(std::int32_t *pairs) const = 0;
    virtual void advance(int substeps, double h) = 0;
};

template <class T, bool estimate>
class GridOf final : public Grid {
    using L = Lanes<T>;
    using V = typename L::V;
    static constexpr int N = L::count;
    enum { X, Y, Z, W, PX, PY, PZ, VX, VY, VZ, FIELDS };
    static constexpr T tiny = sizeof(T) == 4 ? T(1e-20) : T(1e-30);    // against 0 / 0 in padding

    Sheet<T> sheet;
    int strip;
    double rest[3], compliance[3];    // structural, diagonal, next but one
    T gravity;                        // along z

public:
    GridOf(int n, int strip, const double *inv_mass, const double *rest_length,
           const double *compliances, double gravity)
        : sheet(n, FIELDS), strip(strip), gravity(T(gravity)) {
        std::copy(rest_length, rest_length + 3, rest);
        std::copy(compliances, compliances + 3, compliance);
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) sheet.at(i, j)[W * sheet.field] = T(inv_mass[i * n + j]);
    }

    void set(const double *x, const double *v) override {
        for (int i = 0; i < sheet.n; ++i)
            for (int j = 0; j < sheet.n; ++j, x += 3, v += 3)
                for (int k = 0; k < 3; ++k) {
                    sheet.at(i, j)[(X + k) * sheet.field] = T(x[k]);
                    sheet.at(i, j)[(VX + k) * sheet.field] = T(v[k]);
                }
    }

    void get(double *x, double *v) const override {
        for (int i = 0; i < sheet.n; ++i)
            for (int j = 0; j < sheet.n; ++j, x += 3, v += 3)
                for (int k = 0; k < 3; ++k) {
                    x[k] = sheet.at(i, j)[(X + k) * sheet.field];
                    v[k] = sheet.at(i, j)[(VX + k) * sheet.field];
                }
    }

    // Write the edges in the order in which advance() projects them; return how many.
    int order(std::int32_t *pairs) const override {
        const std::int32_t *start = pairs;
        for (int first = 0; first < sheet.n; first += strip)
            edges(first, std::min(first + strip, sheet.n), [](int) { return 0; },
                  [&](T *a, T *b, int count, int) {
                      for (int k = 0; k < count; ++k) {
                          *pairs++ = sheet.particle(a + k);
                          *pairs++ = sheet.particle(b + k);
                      }
                  });
        return static_cast<int>(pairs - start) / 2;
    }

    void advance(int substeps, double h) override {
        struct Kind {
            V rest, alpha;
        };
        const auto constants = [&](int kind) {
            return Kind{L::all(T(rest[kind])), L::all(T(compliance[kind] / (h * h)))};
        };
        const auto run = [field = sheet.field](T *a, T *b, int count, Kind kind) {
            for (int k = 0; k < count; k += N)
                project(a + k, b + k, field, L::first(count - k), kind.rest, kind.alpha);
        };
        for (int s = 0; s < substeps; ++s)
            for (int first = 0; first < sheet.n; first += strip) {
                const int last = std::min(first + strip, sheet.n);
                predict(first, last, T(h));
                edges(first, last, constants, run);
                velocities(std::max(first - 2, 0), last == sheet.n ? last : std::max(last - 2, 0),
                           T(1 / h));
            }
    }

private:
    // Visit all edges whose lower row is in first … last - 1.
    template <class Constants, class Run>
    void edges(int first, int last, Constants constants, Run run) const {
        const auto rows = [&](int kind, int di, int dj) {    // from (i, j) to (i + di, j + dj)
            const auto c = constants(kind);
            for (int half = 0; half < 2; ++half)
                for (int i = std::max(first - di, 0); i + di < last; ++i) {
                    if (i / di % 2 != half) continue;
                    for (int j = 0; j < 4; ++j) {
                        const int left = dj < 0 ? j - dj : j, right = dj < 0 ? j : j + dj;
                        run(sheet.at(i, left), sheet.at(i + di, right),
                            sheet.count(j, dj < 0 ? -dj : dj), c);
                    }
                }
        };
        const auto columns = [&](int kind, int dj) {    // from (i, j) to (i, j + dj)
            const auto c = constants(kind);
            for (int half = 0; half < 2; ++half)
                for (int i = first; i < last; ++i)
                    for (int j = 0; j < 4; ++j)
                        if (j / dj % 2 == half)
                            run(sheet.at(i, j), sheet.at(i, j + dj), sheet.count(j, dj), c);
        };
        columns(0, 1);
        columns(2, 2);
        rows(0, 1, 0);
        rows(1, 1, 1);
        rows(1, 1, -1);
        rows(2, 2, 0);
    }

    static void project(T *a, T *b, int field, typename L::Mask mask, V rest, V alpha) {
        const V ax = L::load(a), ay = L::load(a + field), az = L::load(a + 2 * field);
        const V bx = L::load(b), by = L::load(b + field), bz = L::load(b + 2 * field);
        const V wa = L::load(a + 3 * field), wb = L::load(b + 3 * field);
        const V dx = ax - bx, dy = ay - by, dz = az - bz;
        const V l2 = L::fma(dx, dx, L::fma(dy, dy, L::fma(dz, dz, L::all(tiny))));
        const V w = wa + wb + alpha;
        V s;    // -C / (l (wa + wb + α))
        if (estimate) {
            s = L::fma(rest, L::rsqrt(l2), L::all(-1)) * L::rcp(w);
        } else {
            const V l = L::sqrt(l2);
            s = (rest - l) / (w * l);
        }
        s = L::keep(mask, s);
        const V sa = s * wa, sb = s * wb;
        L::store(a, L::fma(sa, dx, ax));
        L::store(a + field, L::fma(sa, dy, ay));
        L::store(a + 2 * field, L::fma(sa, dz, az));
        L::store(b, L::fnma(sb, dx, bx));
        L::store(b + field, L::fnma(sb, dy, by));
        L::store(b + 2 * field, L::fnma(sb, dz, bz));
    }

    void predict(int first, int last, T h) {
        const int f = sheet.field;
        const V step = L::all(h), fall = L::all(h * gravity);
        for (int i = first; i < last; ++i) {
            T *row = sheet.at(i, 0);
            for (int k = 0; k < 4 * sheet.block; k += N) {
                T *p = row + k;
                const auto free = L::positive(L::load(p + W * f));
                const V x = L::load(p), y = L::load(p + f), z = L::load(p + 2 * f);
                const V vz = L::load(p + VZ * f) + L::keep(free, fall);
                L::store(p + PX * f, x);
                L::store(p + PY * f, y);
                L::store(p + PZ * f, z);
                L::store(p, L::fma(step, L::load(p + VX * f), x));
                L::store(p + f, L::fma(step, L::load(p + VY * f), y));
                L::store(p + 2 * f, L::fma(step, vz, z));
            }
        }
    }

    void velocities(int first, int last, T inv_h) {
        const int f = sheet.field;
        const V rate = L::all(inv_h);
        for (int i = first; i < last; ++i) {
            T *row = sheet.at(i, 0);
            for (int k = 0; k < 4 * sheet.block; k += N) {
                T *p = row + k;
                L::store(p + VX * f, rate * (L::load(p) - L::load(p + PX * f)));
                L::store(p + VY * f, rate * (L::load(p + f) - L::load(p + PY * f)));
                L::store(p + VZ * f, rate * (L::load(p + 2 * f) - L::load(p + PZ * f)));
            }
        }
    }
};
