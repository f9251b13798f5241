// Arrays that come from Python: what a kernel may be given is checked here, before it runs.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <initializer_list>
#include <string>
#include <type_traits>

namespace nb = nanobind;

namespace margcal {

using In = nb::ndarray<nb::ro, nb::device::cpu>;
using Out = nb::ndarray<nb::device::cpu>;

constexpr std::int64_t ANY = -1;

inline std::string shape_text(std::initializer_list<std::int64_t> shape) {
    std::string text = "(";
    for (std::int64_t n : shape) text += (n == ANY ? std::string("n") : std::to_string(n)) + ", ";
    return text + ")";
}

template <class Array> std::string shape_of(const Array& array) {
    std::string text = "(";
    for (std::size_t i = 0; i < array.ndim(); ++i) text += std::to_string(array.shape(i)) + ", ";
    return text + ")";
}

template <class Array> bool contiguous(const Array& array) {
    std::int64_t step = 1;
    for (std::size_t i = array.ndim(); i-- > 0;) {
        if (array.shape(i) > 1 && array.stride(i) != step) return array.size() == 0;
        step *= std::int64_t(array.shape(i));
    }
    return true;
}

// The data of a C-contiguous array of T with this shape (ANY: any length); an error that names the argument otherwise.
template <class T, class Array> T* need(const Array& array, const char* name, std::initializer_list<std::int64_t> shape) {
    const char* kind = !std::is_integral_v<T> ? "float64" : sizeof(T) == 1 ? "uint8" : "int64";
    if (array.dtype() != nb::dtype<std::remove_const_t<T>>())
        throw nb::type_error((std::string(name) + ": expected an array of " + kind).c_str());
    bool fits = array.ndim() == shape.size();
    std::size_t axis = 0;
    for (std::int64_t n : shape) {
        if (!fits) break;
        fits = n == ANY || std::int64_t(array.shape(axis)) == n;
        ++axis;
    }
    if (!fits)
        throw nb::value_error((std::string(name) + ": expected shape " + shape_text(shape) + ", got " + shape_of(array)).c_str());
    if (!contiguous(array)) throw nb::value_error((std::string(name) + ": the array is not C-contiguous").c_str());
    return const_cast<T*>(static_cast<const T*>(static_cast<const void*>(array.data())));
}

}  // namespace margcal
