/*
 * The emulator of the target `avr`: simavr's ATmega1284 with 64 KiB of data memory, for the models of test scenarios.
 * Three registers connect its program with the outside (avr.c): GPIOR0 writes a byte to standard output, GPIOR1 reads one
 * of standard input, at whose end all ends, and GPIOR2 ends with a status.
 */
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_io.h>

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define WRITE 0x3e
#define READ 0x4a
#define STATUS 0x4b
#define CRASHED 98

static FILE *out;

static void finish(int status)
{
    exit(fflush(out) == 0 ? status : 97);
}

static void on_write(avr_t *avr, avr_io_addr_t address, uint8_t byte, void *unused)
{
    (void)avr;
    (void)unused;
    if (address == STATUS)
        finish(byte);
    fputc(byte, out);
}

static uint8_t on_read(avr_t *avr, avr_io_addr_t address, void *unused)
{
    int byte = getchar();

    (void)avr;
    (void)address;
    (void)unused;
    if (byte == EOF)
        finish(0);
    return (uint8_t)byte;
}

int main(int n, char **words)
{
    avr_t *avr = avr_make_mcu_by_name("atmega1284p");
    elf_firmware_t program;
    int state;

    /* simavr writes its own lines to standard output. */
    out = fdopen(dup(STDOUT_FILENO), "wb");
    memset(&program, 0, sizeof program);
    if (n != 2 || avr == NULL || out == NULL || dup2(STDERR_FILENO, STDOUT_FILENO) < 0 ||
        elf_read_firmware(words[1], &program) != 0)
        return 97;
    avr->ramend = UINT16_MAX;
    avr_init(avr);
    avr_load_firmware(avr, &program);
    avr_register_io_write(avr, WRITE, on_write, NULL);
    avr_register_io_write(avr, STATUS, on_write, NULL);
    avr_register_io_read(avr, READ, on_read, NULL);
    do
        state = avr_run(avr);
    while (state != cpu_Done && state != cpu_Crashed);
    finish(CRASHED);
    return CRASHED;
}
