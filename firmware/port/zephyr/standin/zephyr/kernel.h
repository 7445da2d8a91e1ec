/* SPDX-License-Identifier: Apache-2.0 */
/* What the port and the example boards use of Zephyr's kernel, over POSIX threads: they compile and run on this machine.
 * Names and types are those of Zephyr's headers (3.7), what is behind them is ours (kernel.c). No time is kept as on a
 * chip, no interrupt interrupts: a stand-in for the kernel, never for a board.
 */
#ifndef STANDIN_KERNEL_H
#define STANDIN_KERNEL_H

#include <errno.h>
#include <pthread.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/types.h>

#define BIT(n) (1UL << (n))
#define ARRAY_SIZE(array) (sizeof(array) / sizeof((array)[0]))

/* -- time ------------------------------------------------------------------------------------------------------------- */

typedef struct {
    int64_t ns; /* negative: for ever */
} k_timeout_t;

#define K_NO_WAIT ((k_timeout_t){0})
#define K_FOREVER ((k_timeout_t){-1})
#define K_USEC(us) ((k_timeout_t){(int64_t)(us) * 1000})
#define K_MSEC(ms) ((k_timeout_t){(int64_t)(ms) * 1000000})
#define SYS_FOREVER_MS (-1)
#define printk printf
#define CONFIG_TIMER_HAS_64BIT_CYCLE_COUNTER 1

uint64_t k_cycle_get_64(void);
int sys_clock_hw_cycles_per_sec(void);
int32_t k_msleep(int32_t ms);
void k_busy_wait(uint32_t us);

/* -- atomics ---------------------------------------------------------------------------------------------------------- */

typedef long atomic_t;
typedef long atomic_val_t;
#define ATOMIC_INIT(value) (value)
atomic_val_t atomic_get(const atomic_t *target);
atomic_val_t atomic_set(atomic_t *target, atomic_val_t value);
atomic_val_t atomic_inc(atomic_t *target);
bool atomic_cas(atomic_t *target, atomic_val_t before, atomic_val_t after);

/* -- semaphores, queues, locks ------------------------------------------------------------------------------------------ */

struct k_sem {
    pthread_mutex_t lock;
    pthread_cond_t turn;
    unsigned count, limit;
};
#define K_SEM_DEFINE(name, initial, most) \
    struct k_sem name = {PTHREAD_MUTEX_INITIALIZER, PTHREAD_COND_INITIALIZER, initial, most}
int k_sem_take(struct k_sem *sem, k_timeout_t timeout);
void k_sem_give(struct k_sem *sem);
unsigned int k_sem_count_get(struct k_sem *sem);

struct k_msgq {
    pthread_mutex_t lock;
    char *buffer;
    size_t size;
    uint32_t most, first, held;
};
#define K_MSGQ_DEFINE(name, octets, count, align)                  \
    static char name##_buffer[(octets) * (count)] __attribute__((aligned(align))); \
    struct k_msgq name = {PTHREAD_MUTEX_INITIALIZER, name##_buffer, octets, count, 0, 0}
int k_msgq_put(struct k_msgq *queue, const void *data, k_timeout_t timeout);
int k_msgq_get(struct k_msgq *queue, void *data, k_timeout_t timeout);

struct k_spinlock {
    int none;
};
typedef struct {
    int key;
} k_spinlock_key_t;
k_spinlock_key_t k_spin_lock(struct k_spinlock *lock);
void k_spin_unlock(struct k_spinlock *lock, k_spinlock_key_t key);
unsigned int irq_lock(void);
void irq_unlock(unsigned int key);

/* -- threads and timers -------------------------------------------------------------------------------------------------- */

typedef void (*k_thread_entry_t)(void *one, void *two, void *three);
typedef char k_thread_stack_t;
struct k_thread {
    pthread_t handle;
    k_thread_entry_t entry;
    void *one, *two, *three;
};
typedef struct k_thread *k_tid_t;
#define K_THREAD_STACK_DEFINE(name, octets) k_thread_stack_t name[octets]
#define K_THREAD_STACK_SIZEOF(name) sizeof(name)
k_tid_t k_thread_create(struct k_thread *thread, k_thread_stack_t *stack, size_t octets, k_thread_entry_t entry,
                        void *one, void *two, void *three, int priority, uint32_t options, k_timeout_t delay);
#define K_THREAD_DEFINE(name, octets, start, one, two, three, priority, options, delay) \
    static struct k_thread name##_thread = {.entry = start};                           \
    static const k_tid_t name = &name##_thread
void k_thread_start(k_tid_t thread);

struct k_timer {
    void (*expired)(struct k_timer *timer);
    uint64_t generation;
};
#define K_TIMER_DEFINE(name, on_expiry, on_stop) struct k_timer name = {on_expiry, 0}
void k_timer_start(struct k_timer *timer, k_timeout_t duration, k_timeout_t period);
void k_timer_stop(struct k_timer *timer);

/* -- devices --------------------------------------------------------------------------------------------------------------- */

struct device {
    const char *name;
};
extern const struct device standin_can, standin_gpio, standin_pwm, standin_adc;
bool device_is_ready(const struct device *device);

#define DT_CHOSEN(name) name
#define DEVICE_DT_GET(node) (&standin_can)
#define DT_PATH(name) name
#define DT_ALIAS(name) name
#define DT_NODE_EXISTS(node) 1

#endif
