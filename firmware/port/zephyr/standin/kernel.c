/* SPDX-License-Identifier: Apache-2.0 */
/* The stand-in kernel: POSIX threads behind the names of Zephyr's. */
#define _GNU_SOURCE
#include <string.h>
#include <time.h>
#include <zephyr/kernel.h>

static pthread_mutex_t interrupts = PTHREAD_MUTEX_INITIALIZER;

uint64_t k_cycle_get_64(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

int sys_clock_hw_cycles_per_sec(void)
{
    return 1000000000;
}

static void sleep_ns(uint64_t ns)
{
    const struct timespec time = {(time_t)(ns / 1000000000u), (long)(ns % 1000000000u)};
    (void)nanosleep(&time, NULL);
}

int32_t k_msleep(int32_t ms)
{
    sleep_ns((uint64_t)ms * 1000000u);
    return 0;
}

void k_busy_wait(uint32_t us)
{
    const uint64_t until = k_cycle_get_64() + (uint64_t)us * 1000u;
    while (k_cycle_get_64() < until) {
    }
}

atomic_val_t atomic_get(const atomic_t *target)
{
    return __atomic_load_n(target, __ATOMIC_SEQ_CST);
}

atomic_val_t atomic_set(atomic_t *target, atomic_val_t value)
{
    return __atomic_exchange_n(target, value, __ATOMIC_SEQ_CST);
}

atomic_val_t atomic_inc(atomic_t *target)
{
    return __atomic_fetch_add(target, 1, __ATOMIC_SEQ_CST);
}

bool atomic_cas(atomic_t *target, atomic_val_t before, atomic_val_t after)
{
    return __atomic_compare_exchange_n(target, &before, after, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST);
}

int k_sem_take(struct k_sem *sem, k_timeout_t timeout)
{
    struct timespec until;
    int got = 0;
    (void)clock_gettime(CLOCK_REALTIME, &until);
    if (timeout.ns > 0) {
        const int64_t ns = until.tv_nsec + timeout.ns;
        until.tv_sec += (time_t)(ns / 1000000000);
        until.tv_nsec = (long)(ns % 1000000000);
    }
    (void)pthread_mutex_lock(&sem->lock);
    while (sem->count == 0 && got == 0 && timeout.ns != 0) {
        got = timeout.ns < 0 ? pthread_cond_wait(&sem->turn, &sem->lock)
                             : pthread_cond_timedwait(&sem->turn, &sem->lock, &until);
    }
    got = sem->count > 0 ? 0 : timeout.ns == 0 ? -EBUSY : -EAGAIN;
    sem->count -= got == 0;
    (void)pthread_mutex_unlock(&sem->lock);
    return got;
}

void k_sem_give(struct k_sem *sem)
{
    (void)pthread_mutex_lock(&sem->lock);
    sem->count += sem->count < sem->limit;
    (void)pthread_cond_signal(&sem->turn);
    (void)pthread_mutex_unlock(&sem->lock);
}

unsigned int k_sem_count_get(struct k_sem *sem)
{
    unsigned count;
    (void)pthread_mutex_lock(&sem->lock);
    count = sem->count;
    (void)pthread_mutex_unlock(&sem->lock);
    return count;
}

int k_msgq_put(struct k_msgq *queue, const void *data, k_timeout_t timeout)
{
    int failed = 0;
    (void)timeout;
    (void)pthread_mutex_lock(&queue->lock);
    if (queue->held == queue->most) {
        failed = -ENOMSG;
    } else {
        memcpy(queue->buffer + (queue->first + queue->held) % queue->most * queue->size, data, queue->size);
        queue->held++;
    }
    (void)pthread_mutex_unlock(&queue->lock);
    return failed;
}

int k_msgq_get(struct k_msgq *queue, void *data, k_timeout_t timeout)
{
    int failed = 0;
    (void)timeout;
    (void)pthread_mutex_lock(&queue->lock);
    if (queue->held == 0) {
        failed = -ENOMSG;
    } else {
        memcpy(data, queue->buffer + queue->first * queue->size, queue->size);
        queue->first = (queue->first + 1) % queue->most;
        queue->held--;
    }
    (void)pthread_mutex_unlock(&queue->lock);
    return failed;
}

unsigned int irq_lock(void)
{
    (void)pthread_mutex_lock(&interrupts);
    return 0;
}

void irq_unlock(unsigned int key)
{
    (void)key;
    (void)pthread_mutex_unlock(&interrupts);
}

k_spinlock_key_t k_spin_lock(struct k_spinlock *lock)
{
    (void)lock;
    (void)irq_lock();
    return (k_spinlock_key_t){0};
}

void k_spin_unlock(struct k_spinlock *lock, k_spinlock_key_t key)
{
    (void)lock;
    (void)key;
    irq_unlock(0);
}

static void *begin(void *given)
{
    struct k_thread *thread = given;
    thread->entry(thread->one, thread->two, thread->three);
    return NULL;
}

void k_thread_start(k_tid_t thread)
{
    (void)pthread_create(&thread->handle, NULL, begin, thread);
}

k_tid_t k_thread_create(struct k_thread *thread, k_thread_stack_t *stack, size_t octets, k_thread_entry_t entry,
                        void *one, void *two, void *three, int priority, uint32_t options, k_timeout_t delay)
{
    (void)stack;
    (void)octets;
    (void)priority;
    (void)options;
    (void)delay;
    thread->entry = entry;
    thread->one = one;
    thread->two = two;
    thread->three = three;
    k_thread_start(thread);
    return thread;
}

/* A thread for each start: it fires unless another start or a stop came meanwhile. */
typedef struct shot {
    struct k_timer *timer;
    uint64_t generation, ns;
    bool used;
} shot;

static void *fire(void *given)
{
    shot *one = given;
    const shot own = *one;
    __atomic_store_n(&one->used, false, __ATOMIC_SEQ_CST);
    sleep_ns(own.ns);
    (void)irq_lock();
    if (__atomic_load_n(&own.timer->generation, __ATOMIC_SEQ_CST) == own.generation) {
        own.timer->expired(own.timer);
    }
    irq_unlock(0);
    return NULL;
}

void k_timer_start(struct k_timer *timer, k_timeout_t duration, k_timeout_t period)
{
    static shot shots[64];
    static unsigned next;
    pthread_t thread;
    shot *one = &shots[next++ % ARRAY_SIZE(shots)];
    (void)period;
    while (__atomic_load_n(&one->used, __ATOMIC_SEQ_CST)) {
        sleep_ns(1000);
    }
    *one = (shot){timer, __atomic_add_fetch(&timer->generation, 1, __ATOMIC_SEQ_CST), (uint64_t)duration.ns, true};
    if (pthread_create(&thread, NULL, fire, one) == 0) {
        (void)pthread_detach(thread);
    }
}

void k_timer_stop(struct k_timer *timer)
{
    (void)__atomic_add_fetch(&timer->generation, 1, __ATOMIC_SEQ_CST);
}
