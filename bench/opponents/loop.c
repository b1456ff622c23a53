/*
 * What every C program of this bench does: reads a line, does it, answers with a line.
 *
 *     run N         makes N decisions; answers with the seconds they took
 *     check FILE    writes the logits of all decisions it can make as doubles; answers with their count
 *     mark          a mark for callgrind; answers with 0
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

void bench_begin(const char *folder);
void bench_run(long decisions);
long bench_check(FILE *out);
void bench_mark(void);

void *bench_read(const char *folder, const char *name, long *bytes)
{
    char path[4096];
    FILE *file;
    void *data;

    snprintf(path, sizeof path, "%s/%s", folder, name);
    file = fopen(path, "rb");
    if (file == NULL || fseek(file, 0, SEEK_END) != 0 || (*bytes = ftell(file)) < 0)
        exit(3);
    rewind(file);
    data = malloc((size_t)*bytes);
    if (data == NULL || fread(data, 1, (size_t)*bytes, file) != (size_t)*bytes)
        exit(3);
    fclose(file);
    return data;
}

#ifdef WITHOUT_MARKS
void bench_mark(void)
{
}
#endif

int main(int argc, char **argv)
{
    char line[4096], path[4096];
    long n;

    if (argc != 2)
        return 2;
    bench_begin(argv[1]);
    while (fgets(line, sizeof line, stdin) != NULL) {
        if (sscanf(line, "run %ld", &n) == 1) {
            struct timespec began, done;

            clock_gettime(CLOCK_MONOTONIC, &began);
            bench_run(n);
            clock_gettime(CLOCK_MONOTONIC, &done);
            printf("%.9f\n", (double)(done.tv_sec - began.tv_sec) + 1e-9 * (double)(done.tv_nsec - began.tv_nsec));
        } else if (sscanf(line, "check %4095[^\n]", path) == 1) {
            FILE *out = fopen(path, "wb");

            if (out == NULL)
                return 3;
            printf("%ld\n", bench_check(out));
            fclose(out);
        } else {
            bench_mark();
            printf("0\n");
        }
        fflush(stdout);
    }
    return 0;
}
