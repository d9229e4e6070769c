// The one extension module. Each kernel family binds itself in its own file.
#include <nanobind/nanobind.h>

namespace nb = nanobind;

namespace rfcore {
void bind_h264(nb::module_& m);
void bind_live_view(nb::module_& m);
void bind_ngp(nb::module_& m);
void bind_pcm(nb::module_& m);
void bind_raster(nb::module_& m);
void bind_warp(nb::module_& m);
void bind_yuv(nb::module_& m);
}

NB_MODULE(_native, m) {
    m.doc() = "Bit-exact kernels of rfcore; use the wrappers in rfcore.native.";
    rfcore::bind_h264(m);
    rfcore::bind_live_view(m);
    rfcore::bind_ngp(m);
    rfcore::bind_pcm(m);
    rfcore::bind_raster(m);
    rfcore::bind_warp(m);
    rfcore::bind_yuv(m);
}
