// CUDA on one CPU thread, for tests: the threads of a block are fibers, run in turn from barrier to barrier.
#include <algorithm>
#include <cmath>
#include <csetjmp>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <mutex>
#include <ucontext.h>

using std::max;
using std::min;

#define __device__ static
#define __shared__ static
#define KERNEL(threads) static void

struct alignas(16) float4 { float x, y, z, w; };
struct alignas(8) float2 { float x, y; };
static inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
static inline float2 make_float2(float x, float y) { return {x, y}; }
struct Index { int x, y, z; };
static Index threadIdx, blockIdx, blockDim, gridDim;

static inline float __fmaf_rn(float a, float b, float c) { return fmaf(a, b, c); }
static inline float __fmul_rn(float a, float b) { return a * b; }
static inline float __fsub_rn(float a, float b) { return a - b; }
static inline float __fdividef(float a, float b) { return a / b; }
static inline int __clz(int x) { return x ? __builtin_clz(x) : 32; }

namespace shim {
constexpr int MAX_THREADS = 256;
constexpr size_t STACK = 64 << 10;

struct Barrier { int arrived, alive, generation; bool all, result; };
struct Fiber { jmp_buf at; bool done; int side; };

static Fiber fibers[MAX_THREADS];
static Barrier block_barrier, warp_barrier[MAX_THREADS / 32];
static char exchange[2][MAX_THREADS][8];  // two sides in turn: one barrier a shuffle is enough
static char *stacks;
static jmp_buf scheduler;
static std::function<void()> body;
static std::mutex one_launch;
static int running;
static bool backwards;  // threads and blocks run in reverse order: a race changes the results

static void go_on(int t) {
    running = t;
    threadIdx = {t, 0, 0};
    _longjmp(fibers[t].at, 1);
}

static void pause() {  // goes on with the next fiber of the block; the scheduler goes on when none is left
    const int threads = blockDim.x;
    if (_setjmp(fibers[running].at)) return;
    for (int k = 1, t = running; k <= threads; ++k) {
        t = backwards ? (t ? t - 1 : threads - 1) : (t + 1 < threads ? t + 1 : 0);
        if (!fibers[t].done) go_on(t);
    }
    _longjmp(scheduler, 1);
}

static void open(Barrier &b) {
    if (!b.alive || b.arrived != b.alive) return;
    b.result = b.all; b.all = true; b.arrived = 0; ++b.generation;
}

static bool wait(Barrier &b, bool yes = true) {  // whether all said yes
    const int generation = b.generation;
    b.all = b.all && yes; ++b.arrived;
    open(b);
    while (b.generation == generation) pause();
    return b.result;
}

static void leave(Barrier &b) { --b.alive; open(b); }

static void live() {  // a fiber is used by all launches
    if (!_setjmp(fibers[running].at)) _longjmp(scheduler, 1);
    for (;;) {
        body();
        fibers[running].done = true;
        leave(block_barrier);
        leave(warp_barrier[running / 32]);
        pause();
    }
}

static void start(int t) {
    running = t;
    if (_setjmp(scheduler)) return;
    static ucontext_t context;
    getcontext(&context);
    context.uc_stack.ss_sp = stacks + STACK * t;
    context.uc_stack.ss_size = STACK;
    context.uc_link = nullptr;
    makecontext(&context, live, 0);
    setcontext(&context);
}

static void run_block(int threads) {
    block_barrier = {0, threads, 0, true, true};
    for (int w = 0; w < MAX_THREADS / 32; ++w)
        warp_barrier[w] = {0, max(0, min(32, threads - 32 * w)), 0, true, true};
    for (int t = 0; t < threads; ++t) { fibers[t].done = false; fibers[t].side = 0; }
    if (!_setjmp(scheduler)) go_on(backwards ? threads - 1 : 0);
}

template <class S> static void launch(void (*kernel)(S), int blocks, int threads, const S &arguments) {
    std::lock_guard<std::mutex> guard(one_launch);
    if (!stacks) {
        stacks = (char *)malloc(STACK * MAX_THREADS);
        for (int t = 0; t < MAX_THREADS; ++t) start(t);
    }
    body = [&] { kernel(arguments); };
    blockDim = {threads, 1, 1};
    gridDim = {blocks, 1, 1};
    for (int b = 0; b < blocks; ++b) {
        blockIdx = {backwards ? blocks - 1 - b : b, 0, 0};
        run_block(threads);
    }
}

template <class T> static T shuffle(T value, int source) {
    const int t = running, side = fibers[t].side ^= 1;
    memcpy(exchange[side][t], &value, sizeof value);
    wait(warp_barrier[t / 32]);
    memcpy(&value, exchange[side][source], sizeof value);
    return value;
}
}  // namespace shim

extern "C" void run_backwards(int yes) { shim::backwards = yes; }

static void __syncthreads() { shim::wait(shim::block_barrier); }
static void __syncwarp() { shim::wait(shim::warp_barrier[shim::running / 32]); }
static int __syncthreads_and(int yes) { return shim::wait(shim::block_barrier, yes != 0); }
static int __all_sync(unsigned, int yes) { return shim::wait(shim::warp_barrier[shim::running / 32], yes != 0); }
template <class T> static T __shfl_up_sync(unsigned, T value, int d) {
    const int t = shim::running;
    return shim::shuffle(value, t % 32 >= d ? t - d : t);
}
template <class T> static T __shfl_xor_sync(unsigned, T value, int mask) {
    return shim::shuffle(value, shim::running ^ mask);
}
