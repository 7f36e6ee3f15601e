#include "text.h"

#include "protocol.h"

void put(text *out, char c)
{
    if (out->length < TB_REPLY) {
        out->at[out->length++] = c;
    }
}

void say(text *out, const char *words)
{
    while (*words != '\0') {
        put(out, *words++);
    }
}

void say_number(text *out, uint32_t value)
{
    char digits[10];
    size_t n = 0;
    do {
        digits[n++] = (char)('0' + value % 10U);
        value /= 10U;
    } while (value != 0U);
    while (n > 0U) {
        put(out, digits[--n]);
    }
}

void say_crc(text *out, uint32_t value)
{
    int shift;
    for (shift = 28; shift >= 0; shift -= 4) {
        put(out, "0123456789abcdef"[(value >> shift) & 15U]);
    }
}

bool same(const char *a, const char *b)
{
    while (*a != '\0' && *a == *b) {
        a++;
        b++;
    }
    return *a == *b;
}

bool number(const char *word, uint32_t low, uint32_t high, uint32_t *value)
{
    uint32_t sum = 0;
    if (*word == '\0') {
        return false;
    }
    for (; *word != '\0'; word++) {
        uint32_t digit;
        if (*word < '0' || *word > '9') {
            return false;
        }
        digit = (uint32_t)(*word - '0');
        if (sum > (UINT32_MAX - digit) / 10U) {
            return false;
        }
        sum = sum * 10U + digit;
    }
    *value = sum;
    return sum >= low && sum <= high;
}

size_t split(char *line, char *words[TB_WORDS])
{
    size_t n = 1;
    words[0] = line;
    for (; *line != '\0'; line++) {
        if (*line == ' ') {
            *line = '\0';
            if (n == TB_WORDS) {
                return TB_WORDS + 1U;
            }
            words[n++] = line + 1;
        }
    }
    return n;
}

uint32_t crc32_of(uint32_t crc, const char *bytes, size_t length)
{
    static const uint32_t nibbles[16] = {
        0x00000000U, 0x1db71064U, 0x3b6e20c8U, 0x26d930acU, 0x76dc4190U, 0x6b6b51f4U,
        0x4db26158U, 0x5005713cU, 0xedb88320U, 0xf00f9344U, 0xd6d6a3e8U, 0xcb61b38cU,
        0x9b64c2b0U, 0x86d3d2d4U, 0xa00ae278U, 0xbdbdf21cU};
    crc = ~crc;
    while (length-- > 0U) {
        crc ^= (unsigned char)*bytes++;
        crc = nibbles[crc & 15U] ^ (crc >> 4);
        crc = nibbles[crc & 15U] ^ (crc >> 4);
    }
    return ~crc;
}
