// Storage of a sheet of n × n particles for SIMD, in which nothing needs to be shuffled.
//
// Row after row; within a row field after field; within a field the columns j = 0, 4, 8, … side
// by side, then j = 1, 5, …, then 2, 6, … and 3, 7, …. A constraint that joins columns j and j +
// d is then, for every fourth j, a run of unit stride, and for d < 4 no two lanes of it share a
// particle. Padding has inverse mass 0. No lane idles where n / 4 is a whole number of registers
// (64, 128, …); elsewhere this is no lower bound.

#pragma once

#include "lanes.hpp"

#include <cstdlib>
#include <memory>

template <class T>
std::unique_ptr<T[], decltype(&std::free)> zeros(std::size_t count) {
    const std::size_t bytes = (count * sizeof(T) + 63) / 64 * 64;
    T *p = static_cast<T *>(std::aligned_alloc(64, bytes));
    for (std::size_t i = 0; i < bytes / sizeof(T); ++i) p[i] = T(0);
    return {p, &std::free};
}

template <class T>
struct Sheet {
    static constexpr int N = Lanes<T>::count;

    int n;
    int block;     // room for the columns of one class
    int field;     // from one component to the next; an odd number of registers, against aliasing
    int stride;    // from row to row
    std::unique_ptr<T[], decltype(&std::free)> data;

    Sheet(int n, int fields)
        : n(n), block(((n + 3) / 4 + N - 1) / N * N), field(apart(4 * block + N)), stride(fields * field),
          data(zeros<T>(static_cast<std::size_t>(n) * stride + N)) {}

    // At least so long that x, y, z and w of a particle are not near one place of different pages,
    // where a load waits for a store that is under way.
    static int apart(int field) {
        const int page = 4096 / sizeof(T), near = 256 / sizeof(T);
        const auto meets = [&](int k) {
            const int place = k * field % page;
            return place < near || place > page - near;
        };
        while (meets(1) || meets(2) || meets(3)) field += 2 * N;
        return field;
    }

    T *at(int i, int j) const { return &data[i * stride + j % 4 * block + j / 4]; }

    // how many of the columns c, c + 4, c + 8, … have a neighbour d columns on
    int count(int c, int d) const { return n - c - d > 0 ? (n - c - d + 3) / 4 : 0; }

    int particle(const T *p) const {    // its number, row-major; the inverse of at()
        const int k = static_cast<int>(p - data.get()), rest = k % stride;
        return k / stride * n + rest % block * 4 + rest / block;
    }
};
