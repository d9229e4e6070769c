// Growing storage on cache-line boundaries; contents are lost when it grows, and start undefined.
//
// Large buffers ask for huge pages where the system grants them: rendering reads 13 MB of splats in
// depth order, and with pages of 4 KB nearly every one of these reads misses the TLB.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <memory>
#include <new>
#include <type_traits>
#include <utility>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace rfcore {

template <class T>
class AlignedBuffer {
    static_assert(std::is_trivially_copyable_v<T>, "plain data only");

  public:
    // Make room for `count` elements.
    void reserve(size_t count) {
        if (count <= capacity_) return;
        const size_t wanted = count + count / 4 + 64;
        storage_.reset();
        capacity_ = 0;
        storage_.reset(static_cast<T*>(allocate(wanted * sizeof(T))));
        capacity_ = wanted;
    }
    T* data() { return storage_.get(); }
    const T* data() const { return storage_.get(); }
    T& operator[](size_t i) { return storage_.get()[i]; }
    const T& operator[](size_t i) const { return storage_.get()[i]; }

    friend void swap(AlignedBuffer& a, AlignedBuffer& b) noexcept {
        std::swap(a.storage_, b.storage_);
        std::swap(a.capacity_, b.capacity_);
    }

  private:
    static void* allocate(size_t wanted_bytes) {
        constexpr size_t kLine = 64, kHugePage = size_t{2} << 20;
        const size_t unit = wanted_bytes < kHugePage ? kLine : kHugePage;
        const size_t bytes = (wanted_bytes + unit - 1) / unit * unit;
        void* const memory = std::aligned_alloc(unit, bytes);
        if (memory == nullptr) throw std::bad_alloc();
#if defined(MADV_HUGEPAGE)
        if (unit == kHugePage) madvise(memory, bytes, MADV_HUGEPAGE);  // a wish, not a need
#endif
        return memory;
    }

    struct Free {
        void operator()(T* p) const { std::free(p); }
    };
    std::unique_ptr<T, Free> storage_;
    size_t capacity_ = 0;
};

}  // namespace rfcore
