/** A capture that the service has, of which only those bytes are fetched that are needed. */

import { askRange } from "../api/http.ts";
import { capturePath } from "../api/resources.ts";
import { openCapture, type CaptureFile } from "./capture.ts";
import { HEADER, TAIL } from "./npz.ts";

/** Opens the capture of a dataset. Its head and its tail say where all of it is.
 *
 * @param corrected whether keypoints are as they were corrected since, or as they were detected */
export async function remoteCapture(dataset: string, corrected = true): Promise<CaptureFile> {
  const path = capturePath(dataset, corrected);
  const [head, tail] = await Promise.all([askRange(path, 0, HEADER), askRange(path, -TAIL)]);
  const from = tail.size - tail.bytes.byteLength;
  const read = async (start: number, end: number) => {
    if (start >= from) return tail.bytes.slice(start - from, end - from);
    if (end <= head.bytes.byteLength) return head.bytes.slice(start, end);
    const { bytes, size } = await askRange(path, start, end);
    if (size !== tail.size) throw new Error("The dataset has got more frames meanwhile: load the page again.");
    return bytes;
  };
  return openCapture(read, tail.size);
}
