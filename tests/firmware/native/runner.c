/*
 * Runs program.c on a simulated ATmega328P: runner PROGRAM.elf IN_ADDRESS OUT_ADDRESS FREE_ADDRESS. Records of 31
 * bytes on stdin; on stdout the 40 bytes of the outputs and eight counts of cycles: the whole, and stages 1 to 6
 * with 0 for what lies before the first. The stack's greatest depth goes to stderr at the end.
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

static unsigned in_address, out_address, free_address;
static avr_cycle_count_t began, stage_began;
static uint32_t spent[8];
static unsigned stage;
static int over;
static FILE *results;

static void on_gpior0(struct avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    avr->data[address] = value;
    if (value == 1) {
        unsigned char record[31];
        if (fread(record, sizeof record, 1, stdin) != 1) {
            over = 1;
            return;
        }
        memcpy(avr->data + in_address, record, sizeof record);
        memset(spent, 0, sizeof spent);
        began = stage_began = avr->cycle;
        stage = 0;
    } else if (value == 2) {
        spent[7] = (uint32_t)(avr->cycle - began);
        fwrite(avr->data + out_address, 40, 1, results);
        fwrite(spent, sizeof spent, 1, results);
        fflush(results);
    }
}

static void on_gpior1(struct avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    avr->data[address] = value;
    if (stage < 7) {
        spent[stage] += (uint32_t)(avr->cycle - stage_began);
    }
    stage = value;
    stage_began = avr->cycle;
}

int main(int argc, char **argv) {
    elf_firmware_t firmware;
    avr_t *avr;
    unsigned deepest;
    if (argc != 5) {
        return 2;
    }
    in_address = (unsigned)strtoul(argv[2], NULL, 0) & 0xFFFFu;
    out_address = (unsigned)strtoul(argv[3], NULL, 0) & 0xFFFFu;
    free_address = (unsigned)strtoul(argv[4], NULL, 0) & 0xFFFFu;
    /* The simulator talks on stdout. */
    results = fdopen(dup(1), "wb");
    if (results == NULL || dup2(2, 1) < 0) {
        return 6;
    }
    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(argv[1], &firmware) != 0) {
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
    avr_register_io_write(avr, GPIOR0, on_gpior0, NULL);
    avr_register_io_write(avr, GPIOR1, on_gpior1, NULL);
    memset(avr->data + free_address, PATTERN, avr->ramend + 1 - free_address);
    while (!over) {
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            return 5;
        }
    }
    for (deepest = free_address; deepest <= avr->ramend && avr->data[deepest] == PATTERN; deepest++) {
    }
    fprintf(stderr, "stack %u\n", avr->ramend + 1u - deepest);
    return 0;
}
