// Bending on a regular grid: three particles in a row, three in a column, the four of a cell, each
// a linear vector constraint C = Σ k x with a vector multiplier; any masses, one compliance.
//
// The order: rows, columns, cells; each in runs (see sheet.hpp).

#pragma once

#include "sheet.hpp"

#include <algorithm>
#include <cstdint>
#include <vector>

struct Bend {    // in any precision
    virtual ~Bend() = default;
    virtual void set(const double *x) = 0;
    virtual void get(double *x) const = 0;
    virtual int order(std::int32_t *particles) const = 0;
    virtual void weigh(const double *k, double alpha) = 0;
    virtual void project(int passes) = 0;
};

template <class T>
class BendOf final : public Bend {
    using L = Lanes<T>;
    using V = typename L::V;
    static constexpr int N = L::count;
    enum { X, Y, Z, W, FIELDS };

    struct Run {
        T *p[4];       // of three: the middle, the left, the middle, the right
        T k[4];
        bool three;
        int count;     // hinges
        int lambda;    // where their multipliers stand: x, y, z of each N
    };

    Sheet<T> sheet;
    std::vector<Run> runs;
    std::vector<T> lambda;
    T alpha = 0;

public:
    BendOf(int n, const double *inv_mass) : sheet(n, FIELDS) {
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) sheet.at(i, j)[W * sheet.field] = T(inv_mass[i * n + j]);
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < 4; ++j) add({i, i, i, i}, {j + 1, j, j + 1, j + 2}, true);
        for (int i = 0; i + 2 < n; ++i)
            for (int j = 0; j < 4; ++j) add({i + 1, i, i + 1, i + 2}, {j, j, j, j}, true);
        for (int i = 0; i + 1 < n; ++i)
            for (int j = 0; j < 4; ++j) add({i, i, i + 1, i + 1}, {j, j + 1, j, j + 1}, false);
    }

    void set(const double *x) override {
        for (int i = 0; i < sheet.n; ++i)
            for (int j = 0; j < sheet.n; ++j)
                for (int k = 0; k < 3; ++k) sheet.at(i, j)[k * sheet.field] = T(*x++);
    }

    void get(double *x) const override {
        for (int i = 0; i < sheet.n; ++i)
            for (int j = 0; j < sheet.n; ++j)
                for (int k = 0; k < 3; ++k) *x++ = sheet.at(i, j)[k * sheet.field];
    }

    // Write the hinges in the order in which project() takes them; return how many.
    int order(std::int32_t *particles) const override {
        int hinges = 0;
        for (const Run &run : runs) {
            for (int q = 0; q < run.count; ++q)
                for (T *p : run.p) *particles++ = sheet.particle(p + q);
            hinges += run.count;
        }
        return hinges;
    }

    // Take the weights of the hinges, in that order, and their compliance over h².
    void weigh(const double *k, double compliance) override {
        alpha = T(compliance);
        for (Run &run : runs) {
            std::copy(k, k + 4, run.k);
            k += 4 * run.count;
        }
    }

    void project(int passes) override {
        std::fill(lambda.begin(), lambda.end(), T(0));
        for (int pass = 0; pass < passes; ++pass)
            for (const Run &run : runs)
                for (int q = 0; q < run.count; q += N) {
                    const auto mask = L::first(run.count - q);
                    if (run.three) project<1>(run, q, mask, &lambda[run.lambda + 3 * q]);
                    else project<0>(run, q, mask, &lambda[run.lambda + 3 * q]);
                }
    }

private:
    void add(const int (&i)[4], const int (&j)[4], bool three) {
        const auto [left, right] = std::minmax_element(j, j + 4);
        const int count = sheet.count(*left, *right - *left);
        if (count == 0) return;
        Run run{{}, {}, three, count, static_cast<int>(lambda.size())};
        for (int k = 0; k < 4; ++k) run.p[k] = sheet.at(i[k], j[k]);
        runs.push_back(run);
        lambda.resize(lambda.size() + 3 * ((count + N - 1) / N * N));
    }

    template <int first>
    void project(const Run &run, int q, typename L::Mask mask, T *l) const {
        V k[4], wk[4], sum = L::all(alpha);
        for (int i = first; i < 4; ++i) {
            k[i] = L::all(run.k[i]);
            wk[i] = L::load(run.p[i] + q + W * sheet.field) * k[i];
            sum = L::fma(k[i], wk[i], sum);
        }
        const V per_sum = L::keep(mask, L::all(-1) / sum);
        for (int axis = 0; axis < 3; ++axis, l += N) {
            V x[4], c = L::all(alpha) * L::load(l);
            for (int i = first; i < 4; ++i) {
                x[i] = L::load(run.p[i] + q + axis * sheet.field);
                c = L::fma(k[i], x[i], c);
            }
            const V change = c * per_sum;
            L::store(l, L::load(l) + change);
            for (int i = first; i < 4; ++i)
                L::store(run.p[i] + q + axis * sheet.field, L::fma(wk[i], change, x[i]));
        }
    }
};
