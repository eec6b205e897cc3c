/* Flies the stored observations on a simulated Cortex-M4F (QEMU's mps2-an386): reads observations.bin, writes
 * actions.bin and figures.bin, by semihosting. Instructions are counted by SysTick: QEMU's clock goes on by 1 ns with
 * each instruction (-icount shift=0), SysTick by one with each 40 ns. */
#include "policy.h"

#include <stdint.h>
#include <string.h>

extern uint32_t stack_top, bss_begin, bss_end;

int main(void);
void reset(void);
void fault(void);

static uint32_t host(uint32_t operation, const void *arguments)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = arguments;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static uint32_t open_file(const char *name, uint32_t mode)
{
    const uint32_t arguments[3] = {(uint32_t)name, mode, strlen(name)};
    return host(0x01, arguments);
}

static uint32_t transfer(uint32_t operation, uint32_t file, const void *numbers, uint32_t bytes)
{
    const uint32_t arguments[3] = {file, (uint32_t)numbers, bytes};
    return host(operation, arguments); /* the number of bytes that are missing */
}

static void leave(uint32_t code)
{
    const uint32_t arguments[2] = {0x20026, code};
    host(0x20, arguments);
    for (;;) {
    }
}

void fault(void)
{
    leave(1);
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &stack_top, reset, fault, fault, fault, fault, fault, 0, 0, 0, 0, fault, fault, 0, fault, fault};

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88 |= 0xFU << 20; /* the floating-point unit on */
    __asm__ volatile("dsb\n isb");
    memset(&bss_begin, 0, (size_t)((char *)&bss_end - (char *)&bss_begin));
    leave((uint32_t)main());
}

#ifndef POLICY_MEMORY
#define POLICY_MEMORY 0
#endif

static float obs[POLICY_OBSERVATIONS + POLICY_MEMORY], action[POLICY_ACTIONS + POLICY_MEMORY];

static void act(void)
{
#if POLICY_MEMORY
    static policy_state state;
    memcpy(state.memory, obs + POLICY_OBSERVATIONS, sizeof state.memory);
    policy_act(&state, obs, action);
    memcpy(action + POLICY_ACTIONS, state.memory, sizeof state.memory);
#else
    policy_act(obs, action);
#endif
}

int main(void)
{
    static float figures[2];
    volatile uint32_t *const control = (volatile uint32_t *)0xE000E010, *const value = (volatile uint32_t *)0xE000E018;
    const uint32_t in = open_file("observations.bin", 1), out = open_file("actions.bin", 5);
    uint32_t before, call;
    while (!transfer(0x06, in, obs, sizeof obs)) {
        act();
        transfer(0x05, out, action, sizeof action);
    }
    figures[0] = policy_self_test();
    *(volatile uint32_t *)0xE000E014 = 0xFFFFFF;
    *value = 0;
    *control = 5;
    before = *value;
    for (call = 0; call < 8; ++call) {
        act();
    }
    figures[1] = (float)((before - *value) & 0xFFFFFF) * (40.0F / 8.0F);
    transfer(0x05, open_file("figures.bin", 5), figures, sizeof figures);
    return 0;
}
