/* User Mode Linux 6.1 gives a traced process 2696 bytes of extended state. Where the processor has AMX the host's
 * kernel takes nothing but all of it (11008 bytes), and the guest dies before its first process: here what is not
 * given is filled in with what is there. Preloaded into linux-uml; on other machines nothing changes. */
#define _GNU_SOURCE
#include <errno.h>
#include <stdarg.h>
#include <string.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#define PEEKTEXT 1
#define PEEKUSER 3
#define GETREGSET 0x4204
#define SETREGSET 0x4205
#define X86_XSTATE 0x202
#define XSTATE_BV 512                /* where the state says which of its parts are in use */
#define AMX_PARTS (3UL << 17)        /* which the guest never uses */

long ptrace(int request, ...)
{
	static char whole[65536];
	unsigned long peeked;
	va_list arguments;
	va_start(arguments, request);
	int pid = va_arg(arguments, int);
	void *address = va_arg(arguments, void *);
	void *data = va_arg(arguments, void *);
	va_end(arguments);

	if (request == SETREGSET && (long)address == X86_XSTATE) {
		struct iovec *given = data, all = {whole, sizeof whole};
		if (syscall(SYS_ptrace, GETREGSET, pid, address, &all) == 0 && all.iov_len > given->iov_len) {
			memcpy(whole, given->iov_base, given->iov_len);
			*(unsigned long *)(whole + XSTATE_BV) &= ~AMX_PARTS;
			data = &all;
			return syscall(SYS_ptrace, request, pid, address, data);
		}
	}
	if (request < PEEKTEXT || request > PEEKUSER)
		return syscall(SYS_ptrace, request, pid, address, data);
	long failed = syscall(SYS_ptrace, request, pid, address, &peeked); /* the library's own way with these */
	if (failed)
		return failed;
	errno = 0;
	return peeked;
}
