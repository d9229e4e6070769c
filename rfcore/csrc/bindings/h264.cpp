// Binds h264/slice_coder.h. rfcore/codec/h264/slice_coder.py checks values; the types
// below refuse anything else that nanobind can see.
#include "h264/slice_coder.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <mutex>

namespace nb = nanobind;

namespace rfcore {
namespace {

using InPlane = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::device::cpu>;
using OutPlane = nb::ndarray<std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Quantisers = nb::ndarray<const std::int8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Weights = nb::ndarray<const std::uint32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using OutModes = nb::ndarray<std::int8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Planes = std::array<InPlane, 3>;

class LockedCoder {
public:
    LockedCoder(int width, int height, const std::string& isa, int threads)
        : width_(width), height_(height), coder_(width, height, h264::kernels_for(isa.c_str()), threads) {}

    nb::bytes encode(const Planes& frame, const std::vector<Planes>& references, int slice_qp,
                     Quantisers qp, Quantisers forced, Weights lambda_q8, Weights motion_q8,
                     const h264::Effort& effort, bool deblocked, int vertical_reach,
                     const std::array<OutPlane, 3>& out, OutModes modes) {
        if (references.size() > h264::kMaxReferences || lambda_q8.shape(0) != 52 ||
            motion_q8.shape(0) != 52 ||
            qp.shape(0) != macroblocks() || forced.shape(0) != macroblocks() ||
            modes.shape(0) != macroblocks()) {
            throw nb::value_error("arrays do not fit the slice");
        }
        std::array<h264::Picture, h264::kMaxReferences> pictures;
        for (std::size_t i = 0; i < references.size(); ++i) pictures[i] = picture(references[i]);
        const h264::Picture source = picture(frame);
        h264::SliceSettings settings = {};
        settings.slice_qp = slice_qp;
        settings.qp = qp.data();
        std::copy_n(lambda_q8.data(), 52, settings.lambda_q8);
        std::copy_n(motion_q8.data(), 52, settings.motion_q8);
        settings.effort = effort;
        settings.deblocked = deblocked;
        settings.forced = forced.data();
        settings.vertical_reach = vertical_reach;
        for (int p = 0; p < 3; ++p) check(out[p].shape(0), out[p].shape(1), p);
        const std::vector<uint8_t>* bytes;
        std::unique_lock<std::mutex> lock(mutex_, std::defer_lock);
        {
            const nb::gil_scoped_release released;
            lock.lock();
            bytes = &coder_.encode(source, pictures.data(), static_cast<int>(references.size()),
                                   settings);
            for (int p = 0; p < 3; ++p) {
                coder_.reconstruction(p, out[p].data(), static_cast<ptrdiff_t>(out[p].shape(1)),
                                      static_cast<int>(out[p].shape(1)),
                                      static_cast<int>(out[p].shape(0)));
            }
            for (std::size_t i = 0; i < macroblocks(); ++i) {
                modes.data()[i] = coder_.mode(static_cast<int>(i));
            }
        }
        return nb::bytes(bytes->data(), bytes->size());
    }

private:
    std::size_t macroblocks() const {
        return static_cast<std::size_t>(coder_.width_mb()) *
               static_cast<std::size_t>(coder_.height_mb());
    }

    void check(std::size_t height, std::size_t width, int plane) const {
        const int high = plane ? (height_ + 1) / 2 : height_;
        const int wide = plane ? (width_ + 1) / 2 : width_;
        if (height != static_cast<std::size_t>(high) || width != static_cast<std::size_t>(wide)) {
            throw nb::value_error("planes do not fit the picture");
        }
    }

    h264::Picture picture(const Planes& planes) const {
        h264::Picture result;
        for (int p = 0; p < 3; ++p) {
            check(planes[p].shape(0), planes[p].shape(1), p);
            if (planes[p].stride(1) != 1) throw nb::value_error("rows must be contiguous");
            result.plane[p] = planes[p].data();
            result.stride[p] = planes[p].stride(0);
        }
        return result;
    }

    int width_, height_;
    h264::SliceCoder coder_;
    std::mutex mutex_;
};

}  // namespace

void bind_h264(nb::module_& m) {
    using h264::Effort;
    nb::class_<Effort>(m, "SliceEffort")
        .def("__init__",
             [](Effort* made, int search_steps, int subsample_steps, int references_reach,
                int intra_reach, int halves_reach, int shapes_reach, int whole_trials,
                int cost_rounds) {
                 new (made) Effort{search_steps, subsample_steps, references_reach, intra_reach,
                                   halves_reach, shapes_reach, whole_trials, cost_rounds};
             },
             nb::kw_only(), nb::arg("search_steps"), nb::arg("subsample_steps"),
             nb::arg("references_reach"), nb::arg("intra_reach"), nb::arg("halves_reach"),
             nb::arg("shapes_reach"), nb::arg("whole_trials"), nb::arg("cost_rounds"));
    nb::class_<LockedCoder>(m, "SliceCoder")
        .def(nb::init<int, int, const std::string&, int>(), nb::arg("width"), nb::arg("height"),
             nb::arg("isa"), nb::arg("threads") = 1)
        .def("encode", &LockedCoder::encode, nb::arg("frame"), nb::arg("references"),
             nb::arg("slice_qp"), nb::arg("qp"), nb::arg("forced"), nb::arg("lambda_q8"), nb::arg("motion_q8"),
             nb::arg("effort"), nb::arg("deblocked"), nb::arg("vertical_reach"), nb::arg("out"),
             nb::arg("modes"));
}

}  // namespace rfcore
