/**
 * The newest items, in the order in which they came, each under a number that counts up.
 * @template T
 */
export class Ring {
  /** @param {number} capacity how many are kept */
  constructor(capacity) {
    if (!(capacity >= 1)) throw new RangeError(`capacity must be at least 1, got ${capacity}`);
    this.capacity = capacity;
    /** @type {(T | undefined)[]} */
    this.slots = new Array(capacity);
    /** Number that the next item gets. */
    this.next = 0;
  }

  get length() {
    return Math.min(this.next, this.capacity);
  }

  /** Number of the oldest item that is kept. */
  get first() {
    return this.next - this.length;
  }

  /**
   * @param {T} item
   * @returns {number} its number
   */
  push(item) {
    this.slots[this.next % this.capacity] = item;
    return this.next++;
  }

  /**
   * @param {number} number
   * @returns {T | undefined} undefined where it never was or is gone
   */
  get(number) {
    return number >= this.first && number < this.next
      ? this.slots[number % this.capacity]
      : undefined;
  }

  /** @returns {T | undefined} */
  get last() {
    return this.get(this.next - 1);
  }

  /** @returns {T[]} oldest first */
  toArray() {
    const items = [];
    for (let i = this.first; i < this.next; i++) items.push(this.get(i));
    return items;
  }

  clear() {
    this.slots.fill(undefined);
    this.next = 0;
  }
}
