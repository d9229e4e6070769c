// Things that one call at a time may use, kept for the calls that come later.
#pragma once

#include <memory>
#include <mutex>
#include <utility>
#include <vector>

namespace rfcore {

// As many `T` as there were calls at the same time. A thing is in use as long as its `Loan` lives,
// which must end before this does.
template <class T>
class Kept {
  public:
    struct GiveBack {
        Kept* owner;
        void operator()(T* thing) const { owner->put(std::unique_ptr<T>(thing)); }
    };
    using Loan = std::unique_ptr<T, GiveBack>;

    // One that nobody uses, or what `make` returns, a std::unique_ptr<T>.
    template <class Make>
    Loan take(Make make) {
        std::unique_ptr<T> thing = idle();
        if (thing == nullptr) thing = make();
        return Loan(thing.release(), GiveBack{this});
    }

  private:
    std::unique_ptr<T> idle() {
        const std::lock_guard lock(mutex_);
        if (idle_.empty()) return nullptr;
        std::unique_ptr<T> last = std::move(idle_.back());
        idle_.pop_back();
        return last;
    }
    void put(std::unique_ptr<T> thing) {
        const std::lock_guard lock(mutex_);
        idle_.push_back(std::move(thing));
    }

    std::mutex mutex_;
    std::vector<std::unique_ptr<T>> idle_;
};

}  // namespace rfcore
