// Prefix sums and a stable radix sort. Whole numbers: no order of execution changes a result.
#define SCAN_ITEMS 256   // work-items of a group
#define SCAN_VALUES 8    // values of a work-item
#define SORT_ITEMS 64
#define SORT_VALUES 16
#define DIGITS 16

// Make exclusive prefix sums of `values` within blocks of 2048; sums[block] is that of all of it.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1)))
void scan_blocks(uint count, global uint* values, global uint* sums) {
    local uint inclusive[SCAN_ITEMS];
    const uint me = get_local_id(0);
    const uint first = (get_group_id(0) * SCAN_ITEMS + me) * SCAN_VALUES;
    const uint end = min(first + SCAN_VALUES, count);
    uint mine = 0;
    for (uint i = first; i < end; ++i) mine += values[i];
    inclusive[me] = mine;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = 1; step < SCAN_ITEMS; step <<= 1) {
        const uint before = me < step ? 0 : inclusive[me - step];
        barrier(CLK_LOCAL_MEM_FENCE);
        inclusive[me] += before;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    uint next = inclusive[me] - mine;
    for (uint i = first; i < end; ++i) {
        const uint value = values[i];
        values[i] = next;
        next += value;
    }
    if (me == SCAN_ITEMS - 1) sums[get_group_id(0)] = next;
}

kernel void add_block_sums(uint count, global uint* values, global const uint* sums) {
    const uint i = get_global_id(0);
    if (i < count) values[i] += sums[i / (SCAN_ITEMS * SCAN_VALUES)];
}

// sums[group] of 256 values each, in 64 bits.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1)))
void sum_blocks(uint count, global const uint* values, global ulong* sums) {
    local ulong partial[SCAN_ITEMS];
    const uint me = get_local_id(0), i = get_global_id(0);
    partial[me] = i < count ? values[i] : 0;
    for (uint half_of = SCAN_ITEMS / 2; half_of > 0; half_of >>= 1) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (me < half_of) partial[me] += partial[me + half_of];
    }
    if (me == 0) sums[get_group_id(0)] = partial[0];
}

kernel void mark_visible(uint count, global const uint* depth_bits, global uint* marks) {
    const uint n = get_global_id(0);
    if (n < count) marks[n] = depth_bits[n] != INVISIBLE;
}

// Move the visible to the places that the prefix sums of their marks say.
kernel void gather_visible(uint count, global const uint* depth_bits, global const uint* places,
                           global uint* keys, global uint* ids) {
    const uint n = get_global_id(0);
    if (n >= count || depth_bits[n] == INVISIBLE) return;
    keys[places[n]] = depth_bits[n];
    ids[places[n]] = n;
}

// counts[digit][block]: the keys of a block of 1024 with each value of four bits.
kernel __attribute__((reqd_work_group_size(SORT_ITEMS, 1, 1)))
void count_digits(uint count, uint shift, global const uint* keys, global uint* counts) {
    local uint histogram[DIGITS];
    const uint me = get_local_id(0), first = get_group_id(0) * SORT_ITEMS * SORT_VALUES;
    if (me < DIGITS) histogram[me] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint end = min(first + SORT_ITEMS * SORT_VALUES, count);
    for (uint i = first + me; i < end; i += SORT_ITEMS) {
        atomic_inc(&histogram[keys[i] >> shift & (DIGITS - 1)]);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (me < DIGITS) counts[me * get_num_groups(0) + get_group_id(0)] = histogram[me];
}

// Move each pair behind all of a lower digit and those of its digit before it.
kernel __attribute__((reqd_work_group_size(SORT_ITEMS, 1, 1)))
void move_by_digit(uint count, uint shift, global const uint* keys, global const uint* ids,
                   global const uint* starts, global uint* moved_keys, global uint* moved_ids) {
    local uint next[DIGITS][SORT_ITEMS];
    const uint me = get_local_id(0);
    const uint first = (get_group_id(0) * SORT_ITEMS + me) * SORT_VALUES;
    const uint end = min(first + SORT_VALUES, count);
    for (uint digit = 0; digit < DIGITS; ++digit) next[digit][me] = 0;
    for (uint i = first; i < end; ++i) ++next[keys[i] >> shift & (DIGITS - 1)][me];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (me < DIGITS) {
        uint at = starts[me * get_num_groups(0) + get_group_id(0)];
        for (uint item = 0; item < SORT_ITEMS; ++item) {
            const uint of_item = next[me][item];
            next[me][item] = at;
            at += of_item;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = first; i < end; ++i) {
        const uint at = next[keys[i] >> shift & (DIGITS - 1)][me]++;
        moved_keys[at] = keys[i];
        moved_ids[at] = ids[i];
    }
}
