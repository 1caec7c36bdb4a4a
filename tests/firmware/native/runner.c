/*
 * Runs program.c on a simulated ATmega328P. As a program, runner PROGRAM.elf IN_ADDRESS OUT_ADDRESS FREE_ADDRESS:
 * records of 35 bytes on stdin; on stdout the 40 bytes of the outputs and eight counts of cycles: stages 1 to 6 with
 * 0 for what lies before the first, and the whole. The stack's greatest depth goes to stderr at the end.
 * As a shared library, runner_open and runner_tick: a tick for each call, without pipes between.
 */
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_io.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define PATTERN 0xC5
#define GPIOR0 0x3E
#define GPIOR1 0x4A
#define IN_BYTES 35
#define OUT_BYTES 40

/* Nothing but the program is at work on the chip, so the core may run this far before it looks for timers. */
#define CYCLES_IN_A_ROW 100000

static avr_t *avr;
static unsigned in_address, out_address, free_address;
static avr_cycle_count_t began, stage_began;
static uint32_t spent[8];
static unsigned stage;

/* The program asks for a record, or has made its outputs: it stops until runner_tick goes on. */
static void on_gpior0(struct avr_t *core, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    core->data[address] = value;
    if (value == 2) {
        spent[7] = (uint32_t)(core->cycle - began);
    } else if (value == 1) {
        core->state = cpu_Stopped;
    }
}

static void on_gpior1(struct avr_t *core, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    core->data[address] = value;
    if (stage < 7) {
        spent[stage] += (uint32_t)(core->cycle - stage_began);
    }
    stage = value;
    stage_began = core->cycle;
}

static int run_until_asked(void) {
    avr->state = cpu_Running;
    for (;;) {
        int state = avr->state == cpu_Stopped ? cpu_Stopped : avr_run(avr);
        if (state == cpu_Stopped) {
            return 0;
        }
        if (state == cpu_Done || state == cpu_Crashed) {
            return 5;
        }
    }
}

/* Load the program and run it to its first question; 0 when it got there. */
int runner_open(const char *program, unsigned in, unsigned out, unsigned free_from) {
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    in_address = in & 0xFFFFu;
    out_address = out & 0xFFFFu;
    free_address = free_from & 0xFFFFu;
    if (elf_read_firmware(program, &firmware) != 0) {
        return 3;
    }
    avr = avr_make_mcu_by_name("atmega328p");
    if (avr == NULL) {
        return 4;
    }
    avr_init(avr);
    avr->frequency = 16000000;
    avr->log = LOG_ERROR;
    avr_load_firmware(avr, &firmware);
    avr->run_cycle_limit = CYCLES_IN_A_ROW;
    avr_register_io_write(avr, GPIOR0, on_gpior0, NULL);
    avr_register_io_write(avr, GPIOR1, on_gpior1, NULL);
    memset(avr->data + free_address, PATTERN, avr->ramend + 1 - free_address);
    return run_until_asked();
}

/* One tick: a record in, outputs and counts out; 0 when the program came to its end. */
int runner_tick(const unsigned char *record, unsigned char *result) {
    int failed;
    memcpy(avr->data + in_address, record, IN_BYTES);
    memset(spent, 0, sizeof spent);
    began = stage_began = avr->cycle;
    stage = 0;
    failed = run_until_asked();
    memcpy(result, avr->data + out_address, OUT_BYTES);
    memcpy(result + OUT_BYTES, spent, sizeof spent);
    return failed;
}

/* Greatest depth of the stack so far. */
unsigned runner_stack(void) {
    unsigned deepest = free_address;
    while (deepest <= avr->ramend && avr->data[deepest] == PATTERN) {
        deepest++;
    }
    return avr->ramend + 1u - deepest;
}

int main(int argc, char **argv) {
    unsigned char record[IN_BYTES], result[OUT_BYTES + sizeof spent];
    FILE *results;
    int failed;
    if (argc != 5) {
        return 2;
    }
    /* The simulator talks on stdout. */
    results = fdopen(dup(1), "wb");
    if (results == NULL || dup2(2, 1) < 0) {
        return 6;
    }
    failed = runner_open(argv[1], (unsigned)strtoul(argv[2], NULL, 0), (unsigned)strtoul(argv[3], NULL, 0),
                         (unsigned)strtoul(argv[4], NULL, 0));
    while (!failed && fread(record, sizeof record, 1, stdin) == 1) {
        failed = runner_tick(record, result);
        fwrite(result, sizeof result, 1, results);
        fflush(results);
    }
    if (failed) {
        return failed;
    }
    fprintf(stderr, "stack %u\n", runner_stack());
    return 0;
}
