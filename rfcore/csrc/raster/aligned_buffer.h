// Growing storage on cache-line boundaries; contents are lost when it grows, and start undefined.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <memory>
#include <new>
#include <type_traits>
#include <utility>

namespace rfcore {

template <class T>
class AlignedBuffer {
    static_assert(std::is_trivially_copyable_v<T>, "plain data only");

  public:
    // Make room for `count` elements.
    void reserve(size_t count) {
        if (count <= capacity_) return;
        const size_t wanted = count + count / 4 + 64;
        const size_t bytes = (wanted * sizeof(T) + 63) / 64 * 64;
        storage_.reset();
        capacity_ = 0;
        storage_.reset(static_cast<T*>(std::aligned_alloc(64, bytes)));
        if (!storage_) throw std::bad_alloc();
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
    struct Free {
        void operator()(T* p) const { std::free(p); }
    };
    std::unique_ptr<T, Free> storage_;
    size_t capacity_ = 0;
};

}  // namespace rfcore
