// The one extension module. Each kernel family binds itself in its own file.
#include <nanobind/nanobind.h>

namespace nb = nanobind;

NB_MODULE(_native, m) {
    m.doc() = "Bit-exact kernels of rfcore; use the wrappers in rfcore.native.";
}
