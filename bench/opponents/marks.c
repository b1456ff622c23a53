/* Marks in what callgrind counts: from one mark to the next is one part of its output. Nothing outside valgrind. */
#include <valgrind/callgrind.h>

void bench_mark(void)
{
    static int started;

    if (started) {
        CALLGRIND_DUMP_STATS;
    } else {
        CALLGRIND_START_INSTRUMENTATION;
        CALLGRIND_ZERO_STATS;
        started = 1;
    }
}
