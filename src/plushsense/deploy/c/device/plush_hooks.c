/* What plushsense verify --device needs of a chip: bytes of a UART, which are yours to write, and a counter of cycles. */
#include "plush_device.h"

/* ---- Bytes ----------------------------------------------------------------------------------------------------- */

/* They must wait: no byte may be lost or left out. Wherever another file has them, define PLUSH_HOOKS_ELSEWHERE. */
#if defined(PLUSH_HOOKS_ELSEWHERE) || defined(ARDUINO) /* in verify_device.ino */
#elif defined(ESP_PLATFORM)
#include "driver/uart.h"
#include "freertos/FreeRTOS.h"

void plush_hook_begin(void)
{
    uart_config_t port = {.baud_rate = 115200,
                          .data_bits = UART_DATA_8_BITS,
                          .parity = UART_PARITY_DISABLE,
                          .stop_bits = UART_STOP_BITS_1,
                          .flow_ctrl = UART_HW_FLOWCTRL_DISABLE,
                          .source_clk = UART_SCLK_DEFAULT};

    uart_driver_install(UART_NUM_0, 2048, 0, 0, NULL, 0);
    uart_param_config(UART_NUM_0, &port);
}

uint8_t plush_hook_read(void)
{
    uint8_t byte = 0;

    while (uart_read_bytes(UART_NUM_0, &byte, 1, portMAX_DELAY) != 1) {
    }
    return byte;
}

void plush_hook_write(uint8_t byte)
{
    uart_write_bytes(UART_NUM_0, &byte, 1);
}
#elif defined(LIB_PICO_STDIO) /* the Pico SDK: UART or USB, as the target has it */
#include "pico/stdio.h"

void plush_hook_begin(void)
{
    stdio_init_all();
}

uint8_t plush_hook_read(void)
{
    int byte;

    do
        byte = getchar_timeout_us(1000);
    while (byte < 0);
    return (uint8_t)byte;
}

void plush_hook_write(uint8_t byte)
{
    putchar_raw(byte);
}
#else
#error "Write plush_hook_begin(), plush_hook_read() and plush_hook_write() for your UART here."
#endif

/* ---- Cycles ---------------------------------------------------------------------------------------------------- */

#if defined(__XTENSA__)
#define COUNTER "CCOUNT"

uint32_t plush_hook_cycles(void)
{
    uint32_t count;

    __asm__ volatile("rsr %0, ccount" : "=a"(count) : : "memory");
    return count;
}
#elif defined(__riscv) && !defined(ESP_PLATFORM) /* the ESP32-C3 counts elsewhere: see below */
#define COUNTER "mcycle"

uint32_t plush_hook_cycles(void)
{
    uint32_t count;

    __asm__ volatile("csrr %0, mcycle" : "=r"(count) : : "memory");
    return count;
}
#elif defined(__riscv)
#include "esp_cpu.h"
#define COUNTER "esp_cpu_get_cycle_count"

uint32_t plush_hook_cycles(void)
{
    return (uint32_t)esp_cpu_get_cycle_count();
}
#elif defined(__ARM_ARCH_7M__) || defined(__ARM_ARCH_7EM__) || defined(__ARM_ARCH_8M_MAIN__) || \
    defined(__ARM_ARCH_8_1M_MAIN__)
#define COUNTER "DWT CYCCNT"
#define DEMCR (*(volatile uint32_t *)UINT32_C(0xe000edfc))
#define DWT_CTRL (*(volatile uint32_t *)UINT32_C(0xe0001000))
#define DWT_CYCCNT (*(volatile uint32_t *)UINT32_C(0xe0001004))

uint32_t plush_hook_cycles(void)
{
    return DWT_CYCCNT;
}
#else /* such as Cortex-M0+ */
#define COUNTER ""

uint32_t plush_hook_cycles(void)
{
    return 0;
}
#endif

const char *plush_hook_counter = COUNTER;

void plush_hook_begin_counter(void)
{
    uint32_t before, i;

#ifdef DWT_CTRL
    DEMCR |= UINT32_C(1) << 24; /* TRCENA */
    DWT_CYCCNT = 0;
    DWT_CTRL |= 1u; /* CYCCNTENA */
#endif
    before = plush_hook_cycles();
    for (i = 0; i < 1000 && plush_hook_cycles() == before; i++) {
    }
    if (i == 1000) /* some chips and emulators have the registers, and no counter behind them */
        plush_hook_counter = "";
}
