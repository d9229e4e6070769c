// Colours to a codec's picture, as rfcore/csrc/picture/yuv.cpp: a work-item a block of 2x2 pixels.
inline int level(float value, uint zero) {
    return (int)(PRODUCT(within(value, 0.0f, 1.0f), 255.0f) + 0.5f);
}

inline int3 levels_at(global const float* colour, int width, int x, int y, uint zero) {
    const float3 value = vload3((size_t)y * width + x, colour);
    return (int3)(level(value.x, zero), level(value.y, zero), level(value.z, zero));
}

inline uchar luma_of(int3 c) {
    return (uchar)((11966 * c.x + 40254 * c.y + 4064 * c.z + (16 << 16) + (1 << 15)) >> 16);
}

// `picture` holds the planes Y, U, V one after the other.
kernel void codec_picture(constant Camera* camera, global const float* colour,
                          global uchar* picture, uint zero) {
    const int width = camera->width, height = camera->height;
    const int half_width = (width + 1) / 2, half_height = (height + 1) / 2;
    const int block = get_global_id(0);
    if (block >= half_width * half_height) return;
    const int left = 2 * (block % half_width), top = 2 * (block / half_width);
    int3 sum = (int3)(0);
    for (int i = 0; i < 4; ++i) {  // a last odd row or column counts twice
        const int x = min(left + (i & 1), width - 1), y = min(top + (i >> 1), height - 1);
        const int3 levels = levels_at(colour, width, x, y, zero);
        picture[(size_t)y * width + x] = luma_of(levels);
        sum += levels;
    }
    global uchar* u = picture + (size_t)width * height + block;
    const int offset = (128 << 18) + (1 << 17);
    u[0] = (uchar)((-6596 * sum.x - 22188 * sum.y + 28784 * sum.z + offset) >> 18);
    u[half_width * half_height] =
        (uchar)((28784 * sum.x - 26145 * sum.y - 2639 * sum.z + offset) >> 18);
}
