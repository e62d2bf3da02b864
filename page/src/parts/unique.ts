/** Returns 128 random bits as text, also where `crypto.randomUUID` is missing: on plain http of a network. */
export function unique(): string {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}
