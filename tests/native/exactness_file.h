// Files of the programs that test_aarch64*.py run: plain arrays one after the other.
#pragma once

#include <cstdio>
#include <stdexcept>
#include <string>
#include <vector>

class File {
  public:
    File(const char* path, const char* mode) : file_(std::fopen(path, mode)) {
        if (file_ == nullptr) throw std::runtime_error(std::string("cannot open ") + path);
    }
    ~File() { std::fclose(file_); }
    File(const File&) = delete;
    File& operator=(const File&) = delete;

    template <typename T>
    std::vector<T> read(size_t count) {
        std::vector<T> values(count);
        if (std::fread(values.data(), sizeof(T), count, file_) != count) {
            throw std::runtime_error("the scene ends too soon");
        }
        return values;
    }
    template <typename T>
    void write(const std::vector<T>& values) {
        write(values.data(), values.size());
    }
    template <typename T>
    void write(const T* values, size_t count) {
        if (std::fwrite(values, sizeof(T), count, file_) != count) {
            throw std::runtime_error("cannot write the result");
        }
    }

  private:
    std::FILE* file_;
};
