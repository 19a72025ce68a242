// Greedy non-maximum suppression of the best boxes of each map, in two steps. The IoU is that of
// robosac.boxes.pairwise_iou: an integral over the edges of one box, cut to the other.
//
// Of each of some maps there are `each` candidates, best first: logits (n, each), minus infinity for what is none;
// index (n, each); codes (n, each, width). The first of them are looked at: they have boxes (n, looked_at, 5), at most
// MOST. That is defined before this is compiled, and is a multiple of 32.

#define WORDS (MOST / 32)
#define NONE (-__int_as_float(0x7f800000))

struct Box { float x, y, length, width, radius, cosine, sine; };

__device__ float mean_clamp(float p, float q, float limit) {
    float low = fminf(p, q), high = fmaxf(p, q);
    if (!(high > low)) return fminf(fmaxf(low, -limit), limit);
    float a = fminf(fmaxf(low, -limit), limit), b = fminf(fmaxf(high, -limit), limit);
    float above = fmaxf(high, limit) - fmaxf(low, limit), below = fminf(high, -limit) - fminf(low, -limit);
    return ((above - below) * limit + (b - a) * (a + b) / 2) / (high - low);
}

__device__ bool overlap(const Box &a, const Box &b, float iou) {
    float dx = a.x - b.x, dy = a.y - b.y, reach = a.radius + b.radius;
    if (!(dx * dx + dy * dy < reach * reach)) return false;
    float half_length = b.length / 2, half_width = b.width / 2, area = 0, x_before = 0, y_before = 0, cut_before = 0;
    for (int corner = 0; corner <= 4; corner++) {
        float ahead = (corner == 1 || corner == 2 ? -a.length : a.length) / 2;
        float aside = (corner == 2 || corner == 3 ? -a.width : a.width) / 2;
        float east = a.cosine * ahead - a.sine * aside + dx, north = a.sine * ahead + a.cosine * aside + dy;
        float x = b.cosine * east + b.sine * north, y = b.cosine * north - b.sine * east;
        float cut = fminf(fmaxf(x, -half_length), half_length);
        if (corner && cut != cut_before) {
            float slope = (y - y_before) / (x - x_before);
            float from = y_before + (cut_before - x_before) * slope, to = y_before + (cut - x_before) * slope;
            area += (cut - cut_before) * mean_clamp(from, to, half_width);
        }
        x_before = x;
        y_before = y;
        cut_before = cut;
    }
    area = fabsf(area);
    return area > iou * (a.length * a.width + b.length * b.width - area);
}

// Which better ones overlap each box: better (n, looked_at, WORDS), a bit for each. Blocks (n, WORDS) of MOST threads.
extern "C" __global__ void compare(
    const float *logits, const float *boxes, unsigned *better, int each, int looked_at, double iou
) {
    __shared__ Box box[MOST];
    __shared__ bool is_candidate[MOST];
    int me = threadIdx.x, word = blockIdx.y;
    long long map = blockIdx.x;
    is_candidate[me] = me < looked_at && logits[map * each + me] > NONE;
    if (is_candidate[me]) {
        const float *mine = boxes + (map * looked_at + me) * 5;
        float cosine, sine;
        sincosf(mine[4], &sine, &cosine);
        box[me] = {mine[0], mine[1], mine[2], mine[3], hypotf(mine[2], mine[3]) / 2, cosine, sine};
    }
    __syncthreads();
    if (me >= looked_at) return;
    unsigned bits = 0;
    if (is_candidate[me])
        for (int other = 32 * word; other < min(me, 32 * word + 32); other++)
            if (is_candidate[other] && overlap(box[other], box[me], (float)iou)) bits |= 1u << (other % 32);
    better[(map * looked_at + me) * WORDS + word] = bits;
}

// Each of those looked at becomes a row of `few` (n, looked_at, 4 + width): logit, index, whether it survives, whether
// there are no candidates but these; codes. Blocks (n) of MOST threads.
extern "C" __global__ void suppress(
    const float *logits, const long long *index, const float *codes, const unsigned *better, float *few, int each,
    int looked_at, int width
) {
    __shared__ bool is_candidate[MOST];
    __shared__ unsigned overlapped[MOST][WORDS];
    __shared__ unsigned survive[WORDS];
    __shared__ int end;
    int me = threadIdx.x;
    long long map = blockIdx.x;
    logits += map * each;
    if (me == 0) end = 0;
    bool more = false;
    for (int i = looked_at + me; i < each; i += blockDim.x) more |= logits[i] > NONE;
    more = __syncthreads_or(more);
    is_candidate[me] = me < looked_at && logits[me] > NONE;
    if (is_candidate[me]) {
        for (int word = 0; word < WORDS; word++) overlapped[me][word] = better[(map * looked_at + me) * WORDS + word];
        atomicMax(&end, me + 1);
    }
    __syncthreads();
    if (me < 32) {  // one word of survivors a thread of the first warp
        unsigned mine = 0;
        for (int i = 0; i < end; i++) {
            bool is_dead = !is_candidate[i] || (me < WORDS && (overlapped[i][me] & mine));
            if (!__any_sync(0xffffffffu, is_dead) && me == i / 32) mine |= 1u << (i % 32);
        }
        if (me < WORDS) survive[me] = mine;
    }
    __syncthreads();
    if (me < looked_at) {
        float *row = few + (map * looked_at + me) * (4 + width);
        row[0] = logits[me];
        row[1] = (float)index[map * each + me];
        row[2] = (float)(survive[me / 32] >> (me % 32) & 1u);
        row[3] = more ? 0.0f : 1.0f;
        for (int i = 0; i < width; i++) row[4 + i] = codes[(map * each + me) * width + i];
    }
}
