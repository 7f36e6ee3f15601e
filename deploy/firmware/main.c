/* The trigger box on a Raspberry Pi Pico. README.md has the wiring. */
#include <pico/stdlib.h>

#include <hardware/gpio.h>
#include <hardware/timer.h>
#include <hardware/uart.h>
#include <hardware/watchdog.h>

#include "protocol.h"

#define BAUD 115200
#define UART uart0
#define HUNG_MS 100 /* a loop that takes longer resets the chip: outputs float, pull-downs close */

enum { PIN_TX = 0, PIN_RX = 1 };
enum { PIN_LIGHT_GATE = 2, PIN_PROJECTOR_GATE = 3, PIN_CAMERAS = 4 };
enum { PIN_INTERLOCK = 6, PIN_ESTOP = 7, PIN_PATTERN_UP = 8 };

static tb_box box;

static void set_up_pins(void)
{
    const uint outputs[] = {PIN_LIGHT_GATE, PIN_PROJECTOR_GATE, PIN_CAMERAS};
    const uint inputs[] = {PIN_INTERLOCK, PIN_ESTOP, PIN_PATTERN_UP};
    for (size_t i = 0; i < count_of(outputs); i++) {
        gpio_init(outputs[i]);
        gpio_put(outputs[i], false);
        gpio_set_dir(outputs[i], GPIO_OUT);
    }
    for (size_t i = 0; i < count_of(inputs); i++) {
        gpio_init(inputs[i]);
        gpio_pull_up(inputs[i]);
    }
    uart_init(UART, BAUD);
    gpio_set_function(PIN_TX, GPIO_FUNC_UART);
    gpio_set_function(PIN_RX, GPIO_FUNC_UART);
}

/* Safety contacts are normally closed to ground, so an open wire reads as open. The optocoupler of
 * trigger-out pulls down while the pattern is up, so an open wire reads as down. */
static uint32_t read_inputs(void)
{
    return (gpio_get(PIN_INTERLOCK) ? TB_INTERLOCK_OPEN : 0U) |
           (gpio_get(PIN_ESTOP) ? TB_ESTOP_PRESSED : 0U) |
           (gpio_get(PIN_PATTERN_UP) ? 0U : TB_PATTERN_UP);
}

static void write_outputs(uint32_t outputs)
{
    const uint32_t all = 1U << PIN_LIGHT_GATE | 1U << PIN_PROJECTOR_GATE | 1U << PIN_CAMERAS;
    gpio_put_masked(all, ((outputs & TB_LIGHT_GATE) != 0U) << PIN_LIGHT_GATE |
                             ((outputs & TB_PROJECTOR_GATE) != 0U) << PIN_PROJECTOR_GATE |
                             ((outputs & TB_CAMERAS) != 0U) << PIN_CAMERAS);
}

int main(void)
{
    char reply[TB_REPLY];
    size_t length = 0, sent = 0;
    set_up_pins();
    tb_init(&box);
    watchdog_enable(HUNG_MS, true);
    for (;;) {
        const uint32_t now = time_us_32();
        const uint32_t inputs = read_inputs();
        /* The next request is read when the last reply is on its way: the UART never blocks. */
        if (sent == length && uart_is_readable(UART)) {
            sent = 0;
            length = tb_receive(&box, now, inputs, (unsigned char)uart_getc(UART), reply);
        }
        write_outputs(tb_poll(&box, now, inputs));
        if (sent < length && uart_is_writable(UART)) {
            uart_putc_raw(UART, reply[sent++]);
        }
        watchdog_update();
    }
}
