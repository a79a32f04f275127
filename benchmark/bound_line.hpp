// The line solve on a grid: every row, or every column, of distance constraints as one
// tridiagonal system (J W Jᵀ + α) Δλ = -(C + α λ), then x += W Jᵀ Δλ; one line per lane, Thomas's
// algorithm.
//
// With edge k from particle k - 1 to k, u_k its direction and α already over h²:
//     a_k = w_{k-1} + w_k + α_k,  b_k = w_{k-1} u_{k-1}·u_k  (minus the off-diagonal),
//     d_k = 1 / (a_k - b_k² d_{k-1}),  r_k = (rhs_k + b_k r_{k-1}) d_k,          forward
//     Δλ_k = r_k + b_{k+1} d_k Δλ_{k+1}.                                         backward
//
// Particles are row-major, a component apart. Across rows the lanes are neighbouring columns.
// Along rows they are neighbouring rows: tiles are transposed in registers on the way in and on
// the way out. A line's edges are alike: one rest length, one compliance.

#pragma once

#include "sheet.hpp"

#include <algorithm>
#include <cstdint>

struct Lines {    // in any precision
    virtual ~Lines() = default;
    virtual void set(const double *x) = 0;
    virtual void get(double *x, double *lambda) const = 0;
    virtual void solve(int passes) = 0;
};

template <class T, bool estimate, bool along>
class LinesOf final : public Lines {
    using L = Lanes<T>;
    using V = typename L::V;
    using Array = decltype(zeros<T>(0));
    static constexpr int N = L::count;
    static constexpr T tiny = sizeof(T) == 4 ? T(1e-20) : T(1e-30);
    static constexpr T least = sizeof(T) == 4 ? T(1e-6) : T(1e-12);    // pivot, relative to w + w

    int n, depth, stride;    // depth: n rounded up to whole registers
    Array x, y, z, lambda;
    Array w, rest, alpha;                  // turned where the lines run along rows
    Array turned_x, turned_y, turned_z, turned_lambda;
    Array c, r, inv_l;                     // what the forward pass leaves to the backward pass

    struct Line {    // N lines side by side; particle k of them at k * pitch
        T *x, *y, *z, *lambda;
        const T *w, *rest, *alpha;
        int pitch;
    };

    struct State {    // what a particle hands to the next
        V x, y, z, w, dx, dy, dz, inv_l, d, r;
    };

    struct Pull {    // what an edge hands to the one before: of the particle between, its position
        V x[3], impulse[3], last;    // and the impulse on it; the change of the multiplier
    };

public:
    // An edge stands where its first particle does.
    LinesOf(int n, double h, const double *inv_mass, const double *rest_length,
            const double *compliance)
        : n(n), depth((n + N - 1) / N * N), stride(depth + N + depth / N % 2 * N),
          x(sheet()), y(sheet()), z(sheet()), lambda(sheet()), w(sheet()), rest(sheet()),
          alpha(sheet()), turned_x(line()), turned_y(line()), turned_z(line()),
          turned_lambda(line()), c(line()), r(line()), inv_l(line()) {
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) {
                const int to = along ? i / N * depth * N + j * N + i % N : i * stride + j;
                w[to] = T(inv_mass[i * n + j]);
                rest[to] = T(rest_length[i * n + j]);
                alpha[to] = T(compliance[i * n + j] / (h * h));
            }
    }

    void set(const double *p) override {
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j, p += 3) {
                const int k = i * stride + j;
                x[k] = T(p[0]), y[k] = T(p[1]), z[k] = T(p[2]), lambda[k] = T(0);
            }
    }

    void get(double *p, double *multiplier) const override {
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j, p += 3) {
                const int k = i * stride + j;
                p[0] = x[k], p[1] = y[k], p[2] = z[k], *multiplier++ = lambda[k];
            }
    }

    void solve(int passes) override {
        for (int pass = 0; pass < passes; ++pass)
            for (int first = 0; first < n; first += N) along ? rows(first) : columns(first);
    }

private:
    Array sheet() const { return zeros<T>(static_cast<std::size_t>(depth) * stride); }
    Array line() const { return zeros<T>(static_cast<std::size_t>(depth + 1) * N); }

    void columns(int j) {
        const Line line{&x[j], &y[j], &z[j], &lambda[j], &w[j], &rest[j], &alpha[j], stride};
        State s = start(line);
        for (int k = 1; k < n; ++k) forward(line, s, k);
        Pull pull = end(line);
        for (int k = n - 1; k > 0; --k) backward(line, pull, k);
        finish(line, pull);
    }

    void rows(int i) {
        const int turned = i * depth;
        const Line line{turned_x.get(), turned_y.get(), turned_z.get(), turned_lambda.get(),
                        &w[turned], &rest[turned], &alpha[turned], N};
        State s;
        for (int t = 0; t < depth; t += N) {
            const int tile = i * stride + t;
            turn(&x[tile], stride, line.x + t * N, N);
            turn(&y[tile], stride, line.y + t * N, N);
            turn(&z[tile], stride, line.z + t * N, N);
            turn(&lambda[tile], stride, line.lambda + t * N, N);
            if (t == 0) s = start(line);
            for (int k = std::max(t, 1); k < std::min(t + N, n); ++k) forward(line, s, k);
        }
        Pull pull = end(line);
        for (int t = depth - N; t >= 0; t -= N) {
            for (int k = std::min(t + N, n) - 1; k >= std::max(t, 1); --k)
                backward(line, pull, k);
            if (t == 0) finish(line, pull);
            const int tile = i * stride + t;
            turn(line.x + t * N, N, &x[tile], stride);
            turn(line.y + t * N, N, &y[tile], stride);
            turn(line.z + t * N, N, &z[tile], stride);
            turn(line.lambda + t * N, N, &lambda[tile], stride);    // edge t has changed t - 1
        }
    }

    static void turn(const T *from, int from_pitch, T *to, int to_pitch) {
        V tile[N];
        for (int k = 0; k < N; ++k) tile[k] = L::load(from + k * from_pitch);
        L::transpose(tile);
        for (int k = 0; k < N; ++k) L::store(to + k * to_pitch, tile[k]);
    }

    static State start(const Line &line) {
        State s = {};
        s.x = L::load(line.x), s.y = L::load(line.y), s.z = L::load(line.z);
        s.w = L::load(line.w);
        return s;
    }

    void forward(const Line &line, State &s, int k) {
        const int here = k * line.pitch, edge = here - line.pitch;
        const V x1 = L::load(line.x + here), y1 = L::load(line.y + here);
        const V z1 = L::load(line.z + here), w1 = L::load(line.w + here);
        const V alpha = L::load(line.alpha), length = L::load(line.rest);
        const V dx = x1 - s.x, dy = y1 - s.y, dz = z1 - s.z, sum = s.w + w1;
        const V l2 = L::fma(dx, dx, L::fma(dy, dy, L::fma(dz, dz, L::all(tiny))));
        const V per_l = estimate ? L::rsqrt(l2) : L::all(1) / L::sqrt(l2);
        const V b = s.w * (per_l * s.inv_l) * L::fma(dx, s.dx, L::fma(dy, s.dy, dz * s.dz));
        const V rhs = L::fnma(alpha, L::load(line.lambda + edge), L::fnma(l2, per_l, length));
        const V pivot = L::max(L::fnma(b * b, s.d, sum + alpha),
                               L::fma(sum, L::all(least), L::all(tiny)));
        const V d = estimate ? L::rcp(pivot) : L::all(1) / pivot;
        L::store(&c[k * N], b * s.d);
        s = {x1, y1, z1, w1, dx, dy, dz, per_l, d, L::fma(b, s.r, rhs) * d};
        L::store(&r[k * N], s.r);
        L::store(&inv_l[k * N], per_l);
    }

    Pull end(const Line &line) const {
        Pull pull = {};
        const T *const component[3] = {line.x, line.y, line.z};
        for (int q = 0; q < 3; ++q) pull.x[q] = L::load(component[q] + (n - 1) * line.pitch);
        return pull;
    }

    void backward(const Line &line, Pull &pull, int k) {
        const int here = k * line.pitch, edge = here - line.pitch;
        pull.last = L::fma(L::load(&c[(k + 1) * N]), pull.last, L::load(&r[k * N]));
        L::store(line.lambda + edge, L::load(line.lambda + edge) + pull.last);
        const V f = pull.last * L::load(&inv_l[k * N]), w1 = L::load(line.w + here);
        T *const component[3] = {line.x, line.y, line.z};
        for (int q = 0; q < 3; ++q) {
            const V x0 = L::load(component[q] + edge), impulse = f * (pull.x[q] - x0);
            L::store(component[q] + here, L::fma(w1, impulse - pull.impulse[q], pull.x[q]));
            pull.impulse[q] = impulse;
            pull.x[q] = x0;
        }
    }

    static void finish(const Line &line, const Pull &pull) {
        const V w0 = L::load(line.w);
        T *const component[3] = {line.x, line.y, line.z};
        for (int q = 0; q < 3; ++q)
            L::store(component[q], L::fnma(w0, pull.impulse[q], pull.x[q]));
    }
};
